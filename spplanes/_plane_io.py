"""A plane as plain numbers and lists, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from spplanes._check import as_number, as_shape, as_transform

if TYPE_CHECKING:
    from shapely import Polygon

#: normal and d are written for readers of the file; the frame is what counts, and they must agree with it to this.
AGREEMENT = 1e-6


def plane_arguments(data: dict[str, Any]) -> dict[str, Any]:
    """Checked constructor arguments from such a dict; chi2 and outline may be missing."""
    if not isinstance(data, dict):
        raise ValueError(f"data: expected a dict, got {type(data).__name__}")
    missing = [key for key in ("normal", "d", "frame", "covariance", "n_points") if key not in data]
    if missing:
        raise ValueError(f"data: expected the key {missing[0]!r}, got {sorted(map(str, data))}")
    frame = as_transform("frame", data["frame"])
    _check_agreement(frame, data)
    return {
        "frame": frame,
        "covariance": as_shape("covariance", data["covariance"], (3, 3)),
        "n_points": data["n_points"],
        "chi2": data.get("chi2", 0.0),
        "outline": _polygon(data.get("outline")),
    }


def _check_agreement(frame: np.ndarray, data: dict[str, Any]) -> None:
    normal, d = as_shape("normal", data["normal"], (3,)), as_number("d", data["d"])
    distance = float(frame[:3, 2] @ frame[:3, 3])
    if np.abs(normal - frame[:3, 2]).max() > AGREEMENT:
        raise ValueError(f"normal: expected the frame's z axis {frame[:3, 2].tolist()}, got {normal.tolist()}")
    if abs(d - distance) > AGREEMENT * max(1.0, float(np.abs(frame[:3, 3]).max())):
        raise ValueError(f"d: expected the frame's distance {distance}, got {d}")


def rings_of(outline: Polygon) -> list[list[list[float]]]:
    """The rings of an outline, the exterior first."""
    return [[[x, y] for x, y, *_ in ring.coords] for ring in (outline.exterior, *outline.interiors)]


def _polygon(rings: Any) -> Polygon | None:
    if rings is None:
        return None
    from shapely import Polygon  # a slow import that most fits never need

    if not isinstance(rings, (list, tuple)) or not rings:
        raise ValueError(f"outline: expected a list of rings, got {type(rings).__name__}")
    arrays = [as_shape("outline", ring, (None, 2)) for ring in rings]
    if min(len(ring) for ring in arrays) < 4:
        raise ValueError("outline: expected closed rings of at least 4 points, got a shorter one")
    polygon = Polygon(arrays[0], arrays[1:])
    if not polygon.is_valid:
        raise ValueError("outline: expected a valid polygon, got one that crosses itself")
    return polygon
