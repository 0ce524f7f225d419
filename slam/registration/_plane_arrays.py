"""Planes as arrays, for plane registration: the largest of a view, or some as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from slam.geometry.polygons import polygonal, valid
from spplanes import Plane
from spplanes._check import FloatArray

#: Most planes of either side that take part, largest first.
_MOST = 28


class Rings(NamedTuple):
    """Rings of several polygons, outer ones and holes alike, as arrays."""

    corners: FloatArray
    """Of all rings, the last of each the first again, shape (C, 2), m."""
    ends: np.ndarray
    """First corner of each ring, and the number of corners, shape (R + 1,)."""
    of: np.ndarray
    """First ring of each polygon, and the number of rings, shape (N + 1,)."""

    @classmethod
    def of_all(cls, outlines: Sequence[BaseGeometry | None]) -> Rings:
        """Of polygons, multipolygons, or nothing."""
        geometries = np.array([shapely.Polygon() if outline is None else outline for outline in outlines], dtype=object)
        parts, owner = shapely.get_parts(geometries, return_index=True)
        rings, part = shapely.get_rings(parts, return_index=True)
        corners, ring = shapely.get_coordinates(rings, return_index=True)
        ends = np.searchsorted(ring, np.arange(len(rings) + 1))
        return cls(corners, ends, np.searchsorted(owner[part], np.arange(len(geometries) + 1)))


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
    frames: FloatArray
    """Shape (N, 4, 4)."""
    covariances: FloatArray
    """Of (z, theta, psi), shape (N, 3, 3)."""
    bare: np.ndarray
    """Which have no outline and may be anywhere, mask (N,)."""
    rings: Rings
    """Of the outlines."""

    @classmethod
    def of(cls, planes: Sequence[Plane] | PlaneArrays) -> PlaneArrays:
        """The largest, their outlines drawn roughly; arrays that are made already as they are."""
        if isinstance(planes, PlaneArrays):
            return planes
        areas = _areas(planes)
        order = np.argsort(-areas, kind="stable")[:_MOST].tolist()
        return cls.as_given([_drawn_coarsely(planes[k]) for k in order], order, areas[order])

    @classmethod
    def as_given(
        cls, planes: Sequence[Plane], order: Sequence[int] | None = None, areas: FloatArray | None = None
    ) -> PlaneArrays:
        """All of them, with what each is called, and areas that are not those of their outlines."""
        frames = np.array([plane.frame for plane in planes]).reshape(-1, 4, 4)
        normals, middles = frames[:, :3, 2].copy(), frames[:, :3, 3].copy()
        return cls(
            list(planes),
            list(range(len(planes)) if order is None else order),
            normals,
            np.array([plane.d for plane in planes]),
            np.sqrt(np.maximum(_areas(planes) if areas is None else areas, 1e-3)),
            middles,
            np.array([_reach(plane) for plane in planes]),
            frames,
            np.array([plane.covariance for plane in planes]).reshape(-1, 3, 3),
            np.array([plane.outline is None for plane in planes], dtype=bool),
            Rings.of_all([plane.outline for plane in planes]),
        )


def _areas(planes: Sequence[Plane]) -> FloatArray:
    return np.array([0.0 if plane.outline is None else plane.outline.area for plane in planes])


def _reach(plane: Plane) -> float:
    """How far from its centre a plane was seen, m; any distance of one without an outline."""
    if plane.outline is None or plane.outline.is_empty:
        return np.inf
    return float(np.linalg.norm(shapely.get_coordinates(plane.outline), axis=1).max())


def _drawn_coarsely(plane: Plane) -> Plane:
    """The plane with an outline as rough as what is asked of it: whether two meet, and what they have in common."""
    if plane.outline is None:
        return plane
    outline = polygonal(valid(plane.outline.simplify(0.05)))
    return Plane._trusted(plane.frame, plane.covariance, plane.n_points, outline)  # type: ignore[arg-type]
