"""planes.json: planes as a file, in the format spplanes/1."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from slam.errors import LogError, cannot_be_read
from spplanes.plane import Plane

#: What the file says it is.
FORMAT = "spplanes/1"
_KEYS = ("normal", "d", "frame", "covariance", "n_points", "outline")


class Landmark(Protocol):
    """A plane of a map as a file tells it: `StoredPlane`, or the estimator's own `slam.MapPlane`."""

    @property
    def id(self) -> int:
        """The landmark's number."""

    @property
    def plane(self) -> Plane:
        """The plane, in the world."""

    @property
    def observations(self) -> int:
        """Number of keyframes that saw it."""


class StoredPlane(NamedTuple):
    """One entry of a planes.json."""

    id: int
    """The landmark's number."""
    plane: Plane
    """The plane, in the frame of the file."""
    observations: int
    """Number of keyframes that saw it."""


def write_planes(
    path: Path | str, planes: Iterable[Plane | Landmark], beside: Mapping[int, Mapping[str, object]] | None = None
) -> None:
    """Write the planes of a map; one that is no landmark has its place in the sequence for an id, seen by nobody.

    Floats survive exactly. ``beside`` has further keys of planes, by id, for whoever reads them.
    """
    entries = []
    for number, given in enumerate(planes):
        one = StoredPlane(number, given, 0) if isinstance(given, Plane) else given
        data, more = one.plane.to_dict(), (beside or {}).get(one.id, {})
        entries.append({"id": one.id, **{key: data[key] for key in _KEYS}, "observations": one.observations, **more})
    document = {"format": FORMAT, "frame": "world", "planes": entries}
    Path(path).write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


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
        raise cannot_be_read(path, error) from error
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
