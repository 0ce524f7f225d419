"""The largest planes of a view as arrays, for plane registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from slam.geometry.polygons import polygonal, valid
from spplanes import Plane
from spplanes._check import FloatArray

#: Most planes of either side that take part, largest first.
_MOST = 28
#: Outlines are simplified to this, m.
_ROUGH = 0.05


@dataclass(frozen=True, eq=False)
class PlaneArrays:
    """The largest planes as arrays."""

    planes: list[Plane]
    """Largest first, their outlines drawn roughly; an outline may be of several polygons."""
    order: list[int]
    """Which each is of those given."""
    normals: FloatArray
    """Shape (N, 3)."""
    distances: FloatArray
    """Along the normals, shape (N,), m."""
    weights: FloatArray
    """Root of the area, shape (N,), m."""
    middles: FloatArray
    """Centres, shape (N, 3), m."""
    reaches: FloatArray
    """How far from its centre each was seen, shape (N,), m."""

    @classmethod
    def of(cls, planes: Sequence[Plane]) -> PlaneArrays:
        areas = np.array([0.0 if plane.outline is None else plane.outline.area for plane in planes])
        order = np.argsort(-areas, kind="stable")[:_MOST].tolist()
        chosen = [_drawn_coarsely(planes[k]) for k in order]
        return cls(
            chosen,
            order,
            np.array([plane.normal for plane in chosen]).reshape(-1, 3),
            np.array([plane.d for plane in chosen]),
            np.sqrt(np.maximum(areas[order], 1e-3)),
            np.array([plane.centre for plane in chosen]).reshape(-1, 3),
            np.array([_reach(plane) for plane in chosen]),
        )


def _reach(plane: Plane) -> float:
    """How far from its centre a plane was seen, m; any distance of one without an outline."""
    if plane.outline is None or plane.outline.is_empty:
        return np.inf
    return float(np.linalg.norm(shapely.get_coordinates(plane.outline), axis=1).max())


def _drawn_coarsely(plane: Plane) -> Plane:
    """The plane with an outline as rough as what is asked of it: whether two meet, and what they have in common."""
    if plane.outline is None:
        return plane
    outline = polygonal(valid(plane.outline.simplify(_ROUGH)))
    return Plane._trusted(plane.frame, plane.covariance, plane.n_points, outline)  # type: ignore[arg-type]
