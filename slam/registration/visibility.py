"""Visibility: what is seen cannot lie behind a known wall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from slam.geometry.frames import inverse, lift
from spplanes import Plane
from spplanes._check import FloatArray

#: A ray meets a wall so far before what it sees, m, so far inside the wall's outline, m, and at least this steeply
#: (sine of 10 deg), or nothing is said: outlines and motions are not known better.
_BEFORE_M, _INSIDE_M, _STEEP = 0.3, 0.1, 0.17
#: Rays to a plane: a grid of so many by so many over the box around its outline, those that meet it.
_GRID = 3


@dataclass(frozen=True, eq=False)
class LinesOfSight:
    """Rays from a sensor to the planes that it sees, and known planes that may stand in their way."""

    ends: FloatArray
    """Where the rays end, in the frame of the sensor, shape (N, 3), m."""
    shares: FloatArray
    """Of its plane's weight what each ray carries, shape (N,)."""
    walls: tuple[tuple[FloatArray, shapely.Polygon | shapely.MultiPolygon], ...]
    """Frame (4, 4) and outline, less its border, of the known planes."""

    @classmethod
    def between(cls, seen: Sequence[Plane], weights: FloatArray, known: Sequence[Plane]) -> LinesOfSight:
        """Of planes seen, in the sensor's frame, with a weight (K,) each, and known ones, in a frame of their own."""
        rays = [points_on(plane) for plane in seen]
        shares = [np.full(len(some), weight / max(len(some), 1)) for some, weight in zip(rays, weights, strict=True)]
        inner = [(plane.frame, plane.outline.buffer(-_INSIDE_M)) for plane in known if plane.outline is not None]
        walls = tuple((frame, outline) for frame, outline in inner if not outline.is_empty)
        return cls(np.concatenate([np.empty((0, 3)), *rays]), np.concatenate([np.empty(0), *shares]), walls)

    def blocked(self, known_T_sensor: FloatArray) -> float:
        """Weight of what would be seen through known walls if the sensor were there."""
        return float(self.shares[self.stopped_by(known_T_sensor) >= 0].sum())

    def stopped_by(self, known_T_sensor: FloatArray) -> np.ndarray:
        """For every ray the first of the walls, by number, that would stop it, -1 for none, shape (N,)."""
        origin, rays = known_T_sensor[:3, 3], self.ends @ known_T_sensor[:3, :3].T
        lengths = np.linalg.norm(rays, axis=1)
        stopped = np.full(len(rays), -1)
        for number, (frame, outline) in enumerate(self.walls):
            normal = frame[:3, 2]
            along = rays @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                reached = (normal @ (frame[:3, 3] - origin)) / along
                near = (reached * lengths > _BEFORE_M) & ((1.0 - reached) * np.abs(along) > _BEFORE_M)
            met = np.flatnonzero(near & (np.abs(along) > _STEEP * lengths) & (stopped < 0))
            if len(met):
                places = lift(origin + reached[met, None] * rays[met], inverse(frame))
                stopped[met[shapely.contains_xy(outline, places[:, 0], places[:, 1])]] = number
        return stopped


def points_on(plane: Plane) -> FloatArray:
    """A few points (N, 3) spread over a plane's outline; none without one."""
    outline = plane.outline
    if outline is None or outline.is_empty:
        return np.empty((0, 3))
    x0, y0, x1, y1 = outline.bounds
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(x0 + steps * (x1 - x0), y0 + steps * (y1 - y0))
    inside = shapely.contains_xy(outline, x, y)
    places = np.stack((x[inside], y[inside], np.zeros(int(inside.sum()))), axis=1)
    if not len(places):
        middle = outline.representative_point()
        places = np.array([[middle.x, middle.y, 0.0]])
    return lift(places, plane.frame)
