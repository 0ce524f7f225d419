"""Visibility: what is seen cannot lie behind a known wall, and what was seen through is not there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely
from scipy.spatial import KDTree

from slam.frontend.scan_surfaces import ON_EDGE, WIDTH, weights_of
from slam.geometry.frames import inverse, lift
from spplanes import Plane
from spplanes._check import FloatArray

#: A ray meets a wall so far before what it sees, m, so far inside the wall's outline, m, and at least this steeply
#: (sine of 10 deg), or nothing is said: outlines and motions are not known better.
_BEFORE_M, _INSIDE_M, _STEEP = 0.3, 0.1, 0.17
#: Rays to a plane: a grid of so many by so many over the box around its outline, those that meet it.
_GRID = 3
#: Two surface elements look the same way to this cosine; of edges, whose direction turns with the viewpoint, likewise.
ALIKE = 0.85
#: One direction are elements within this angle, rad, or `NEIGHBOURS_APART`, when there are so many; something stands
#: before them when it is nearer than all by this share of the range and so many m.
_DIRECTION_RAD, _ABOUT, _NEARER_SHARE, _NEARER_M = 0.1, 4, 0.08, 0.1
#: Elements of one surface that lie beside each other are this many widths apart at most.
NEIGHBOURS_APART = 1.7


@dataclass(frozen=True, eq=False)
class LinesOfSight:
    """Rays from a sensor to the planes that it sees, and known planes that may stand in their way."""

    ends: FloatArray
    """Where the rays end, in the frame of the sensor, shape (N, 3), m."""
    shares: FloatArray
    """Of its plane's weight what each ray carries, shape (N,)."""
    walls: tuple[tuple[FloatArray, shapely.Polygon | shapely.MultiPolygon], ...]
    """Frame (4, 4) and outline, less its border, of the known planes."""
    starts: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Where the rays begin in that frame, shape (3,) or, of a sensor that moved on meanwhile, (N, 3), m."""

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
        origin, turn = known_T_sensor[:3, 3], known_T_sensor[:3, :3].T
        rays, starts = (self.ends - self.starts) @ turn, np.broadcast_to(self.starts, self.ends.shape) @ turn
        lengths = np.linalg.norm(rays, axis=1)
        stopped = np.full(len(rays), -1)
        for number, (frame, outline) in enumerate(self.walls):
            normal = frame[:3, 2]
            along = rays @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                reached = (normal @ (frame[:3, 3] - origin) - starts @ normal) / along
                near = (reached * lengths > _BEFORE_M) & ((1.0 - reached) * np.abs(along) > _BEFORE_M)
            met = np.flatnonzero(near & (np.abs(along) > _STEEP * lengths) & (stopped < 0))
            if len(met):
                places = lift(origin + starts[met] + reached[met, None] * rays[met], inverse(frame))
                stopped[met[shapely.contains_xy(outline, places[:, 0], places[:, 1])]] = number
        return stopped


def points_on(plane: Plane) -> FloatArray:
    """A few points (N, 3) spread over a plane's outline; none without one."""
    outline = plane.outline
    if outline is None or outline.is_empty:
        return np.empty((0, 3))
    x0, y0, x1, y1 = outline.bounds
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.tile(x0 + steps * (x1 - x0), _GRID), np.repeat(y0 + steps * (y1 - y0), _GRID)
    inside = shapely.contains_xy(outline, x, y)
    places = np.stack((x[inside], y[inside], np.zeros(int(inside.sum()))), axis=1)
    if not len(places):
        middle = outline.representative_point()
        places = np.array([[middle.x, middle.y, 0.0]])
    return lift(places, plane.frame)


@dataclass(frozen=True, eq=False)
class Scan:
    """A 3D scan as it is registered: what it saw, how far other points are from that, and which stand before it."""

    elements: FloatArray
    """Its surface elements in the body frame, shape (N, 9); see `slam.frontend.scan_surfaces`."""
    viewpoint: FloatArray
    """Where the sensor was, in the body frame, shape (3,), m."""

    @cached_property
    def weights(self) -> FloatArray:
        """How much each of its elements says, shape (N,), in things."""
        return weights_of(self.elements)

    @cached_property
    def _rays(self) -> FloatArray:
        return self.elements[:, :3] - self.viewpoint

    @cached_property
    def _depth(self) -> FloatArray:
        return np.linalg.norm(self._rays, axis=1)

    @cached_property
    def _direction_rad(self) -> float:
        widths = self.elements[:, WIDTH] / np.maximum(self._depth, 1e-9)
        return max(_DIRECTION_RAD, NEIGHBOURS_APART * float(np.median(widths)) if len(widths) else 0.0)

    @cached_property
    def _directions(self) -> KDTree:
        return tree_of(self._rays / np.maximum(self._depth, 1e-9)[:, None])

    @cached_property
    def _places(self) -> KDTree:
        return tree_of(self.elements[:, :3])

    def apart(self, points: FloatArray, reach: FloatArray | float) -> np.ndarray:
        """Which of points (N, 3) have nothing that was seen within reach of them, (N,) or of all, m."""
        far = self._places.query(points, distance_upper_bound=np.max(reach, initial=0.0))[0]
        return np.asarray(far > reach)

    def through(
        self, points: FloatArray, nearer_m: float = _NEARER_M, nearer_share: float = _NEARER_SHARE
    ) -> np.ndarray:
        """Which of points (N, 3) stand so far before all that was seen about their direction, shape (N,).

        That is known between directions that were seen, not beside them: where a field of view ends, or a surface that
        gave no return begins, all that was seen is on one side.

        Before a surface is what is nearer than it and off it: beside what was seen of a wall the wall goes on, and
        along it the range is any.
        """
        through = np.zeros(len(points), dtype=bool)
        common, about = self._about(points)
        rays = points[common] - self.viewpoint
        between = _between(rays, self._rays[about])
        common, about, rays = common[between], about[between], rays[between]
        ranges = np.linalg.norm(rays, axis=1)
        nearer = ranges[:, None] < (1.0 - nearer_share) * self._depth[about] - nearer_m
        behind = self.elements[about]
        off = np.einsum("kai,kai->ka", points[common, None] - behind[..., :3], behind[..., 3:6])
        through[common] = (nearer & ((off > nearer_m) | (behind[..., 7] == ON_EDGE))).all(axis=1)
        return through

    def off_surfaces(self, elements: FloatArray) -> FloatArray:
        """How far elements (N, 9) are from the surface about their direction, (N,), m; infinite: there is none of it.

        A surface goes on between the beams that it was seen by. Of those about a direction that look the same way the
        nearest counts; across an edge nothing goes on.
        """
        apart = np.full(len(elements), np.inf)
        common, index = self._about(elements[:, :3])
        mine, about = elements[common], self.elements[index]
        off = np.abs(np.einsum("kai,kai->ka", mine[:, None, :3] - about[..., :3], about[..., 3:6]))
        alike = np.einsum("ki,kai->ka", mine[:, 3:6], about[..., 3:6]) > ALIKE
        on_surfaces = (about[..., 7] != ON_EDGE) & (mine[:, None, 7] != ON_EDGE)
        apart[common] = np.where(alike & on_surfaces, off, np.inf).min(axis=1, initial=np.inf)
        return apart

    def _about(self, points: FloatArray) -> tuple[np.ndarray, np.ndarray]:
        """Which of points (N, 3) something was seen about the direction of, (K,), and what it was, (K, _ABOUT)."""
        if len(points) == 0 or len(self.elements) < _ABOUT:
            return np.empty(0, dtype=np.int64), np.empty((0, _ABOUT), dtype=np.int64)
        rays = points - self.viewpoint
        directions = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)[:, None]
        apart, index = self._directions.query(directions, k=_ABOUT, distance_upper_bound=self._direction_rad)
        common = np.flatnonzero(np.isfinite(apart).all(axis=1))
        return common, np.asarray(index)[common]


def _between(rays: FloatArray, about: FloatArray) -> np.ndarray:
    """Which rays (N, 3) have rays (N, K, 3) on all sides of them, shape (N,): no open half plane holds all of these."""
    along = rays / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)[:, None]
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)]) if len(along) else along
    x, y = (np.einsum("kai,ki->ka", about, axis) for axis in (side, np.cross(along, side)))
    bearings = np.sort(np.arctan2(y, x), axis=1)
    gaps = np.diff(bearings, axis=1, append=bearings[:, :1] + 2.0 * np.pi)
    return gaps.max(axis=1) < np.pi + 1e-9  # to which angles are computed


def tree_of(points: FloatArray) -> KDTree:
    """A tree that is asked a few times only: made fast rather than good."""
    return KDTree(points, balanced_tree=False, compact_nodes=False)
