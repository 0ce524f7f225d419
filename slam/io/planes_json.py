"""planes.json: planes as a file, in the format spplanes/1."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from slam.errors import LogError
from spplanes.plane import Plane

#: What the file says it is.
FORMAT = "spplanes/1"
_KEYS = ("normal", "d", "frame", "covariance", "n_points", "outline")


def write_planes(path: Path | str, planes: Sequence[Plane]) -> None:
    """Write planes; the id of each is its place in the sequence. Floats survive exactly."""
    entries = []
    for index, plane in enumerate(planes):
        data = plane.to_dict()
        entries.append({"id": index, **{key: data[key] for key in _KEYS}, "observations": 0})
    document = {"format": FORMAT, "frame": "world", "planes": entries}
    Path(path).write_text(json.dumps(document, indent=1, allow_nan=False), encoding="utf-8")


class StoredPlane(NamedTuple):
    """One entry of a planes.json."""

    id: int
    """The landmark's number."""
    plane: Plane
    """The plane, in the frame of the file."""
    observations: int
    """Number of keyframes that saw it."""


def read_planes(path: Path | str) -> list[Plane]:
    """Read the planes of a planes.json, in the order of the file; errors as `read_map`."""
    return [stored.plane for stored in read_map(path)]


def read_map(path: Path | str) -> list[StoredPlane]:
    """Read the planes of a planes.json with their ids, in the order of the file.

    Raises:
        LogError: one sentence with the file, and the plane that is wrong: not JSON, another format, missing keys, a
            frame or a covariance that is none.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:  # a JSONDecodeError or UnicodeDecodeError is a ValueError
        raise LogError(path, "expected JSON, got a syntax error", line=getattr(error, "lineno", None)) from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise LogError(path, f"expected the format {FORMAT!r}")
    entries = document.get("planes")
    if not isinstance(entries, list):
        raise LogError(path, "expected a list under 'planes'")
    planes = []
    for index, entry in enumerate(entries):
        try:
            plane = Plane.from_dict(entry)
            planes.append(StoredPlane(_count(entry, "id", index), plane, _count(entry, "observations", 0)))
        except ValueError as error:
            raise LogError(path, f"planes[{index}]: {error}") from error
    return planes


def _count(entry: dict[str, object], key: str, default: int) -> int:
    number = entry.get(key, default)
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 2**31:
        raise ValueError(f"{key}: expected a whole number from 0 up, got {str(number)[:20]!r}")
    return number
