"""What a drive goes through: a world, the course of the robot in it, and people who walk about."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from benchmarks.corpus.polygon_world import PolygonWorld
from slam.simulation.robots import Path
from slam.simulation.robots import pose_matrices as level_poses
from slam.simulation.world import NO_PLANE, cast_scans
from spplanes._check import FloatArray

#: A robot is so long that it takes the foot of a ramp over this way, m.
_WHEELBASE_M = 0.6
#: People: radius and height, m; nobody comes nearer to the robot than this, m.
_GIRTH_M, _TALL_M, _POLITE_M = 0.25, 1.75, 0.6


@dataclass(frozen=True, eq=False)
class Course:
    """The way of a robot, over floors and ramps."""

    path: Path
    heights_m: FloatArray | None = None
    """Height of the floor at each stored point of the path, shape (K,), m; None: level at 0."""

    @property
    def level(self) -> bool:
        """Whether the robot stays on one floor."""
        return self.heights_m is None

    @property
    def length_m(self) -> float:
        """Length seen from above, m."""
        return self.path.length_m

    def part(self, start: float, end: float, *, backwards: bool = False) -> "Course":
        """The course from one share of its length to another, or from there back; level ones only."""
        if not 0.0 <= start < end <= 1.0:
            raise ValueError(f"part: expected shares of the way with 0 <= start < end <= 1, got {start} and {end}")
        if self.heights_m is not None:
            raise ValueError("part: expected a level course, got one with ramps")
        path, start_m, end_m = self.path, start * self.length_m, end * self.length_m
        way = np.array([start_m, *path.way_m[(path.way_m > start_m) & (path.way_m < end_m)], end_m])
        poses = path.at(way)
        if backwards:
            return Course(Path(end_m - way[::-1], poses[::-1] + np.array([0.0, 0.0, np.pi])))
        return Course(Path(way - start_m, poses))

    def poses_at(self, way_m: FloatArray) -> FloatArray:
        """world_T_body after ways (N,) seen from above, m; shape (N, 4, 4)."""
        poses = level_poses(self.path.at(way_m))
        if self.heights_m is None:
            return poses
        step = float(self.path.way_m[-1]) / (len(self.path.way_m) - 1)
        smooth = uniform_filter1d(self.heights_m, max(int(_WHEELBASE_M / step), 1), mode="nearest")
        poses[:, 2, 3] = np.interp(way_m, self.path.way_m, smooth)
        pitch = -np.arctan(np.interp(way_m, self.path.way_m, np.gradient(smooth, self.path.way_m)))
        poses[:, :3, :3] = poses[:, :3, :3] @ _about_y(pitch)
        return poses


def _about_y(angles: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) about y by angles (N,), rad."""
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, 0, 0] = turns[:, 2, 2] = np.cos(angles)
    turns[:, 0, 2], turns[:, 2, 0] = np.sin(angles), -np.sin(angles)
    return turns


@dataclass(frozen=True, eq=False)
class Walker:
    """Somebody who walks up and down the robot's way, to its left, from a place on it at time 0."""

    start_m: float
    speed_m_per_s: float  # along the way, m/s; negative: toward its start
    beside_m: float

    def places(self, path: Path, times_s: FloatArray) -> FloatArray:
        """Positions (N, 2) at times (N,), m."""
        length = path.length_m
        way = np.remainder(self.start_m + self.speed_m_per_s * times_s, 2.0 * length)
        x, y, heading = path.at(np.where(way < length, way, 2.0 * length - way)).T
        return np.column_stack([x - self.beside_m * np.sin(heading), y + self.beside_m * np.cos(heading)])


@dataclass(frozen=True, eq=False)
class Scene:
    """A world to drive through: what stands still, the way, and people."""

    world: PolygonWorld
    course: Course
    walkers: tuple[Walker, ...] = ()

    def cast(
        self, origins: FloatArray, rays: FloatArray, fan_normals: FloatArray, times_s: FloatArray
    ) -> tuple[FloatArray, np.ndarray]:
        """As `World.cast`, each scan (S,) at its own time, with the people where they are then."""
        ranges, labels = self.world.cast(origins, rays, fan_normals)
        if self.walkers:
            places = np.stack([one.places(self.course.path, times_s) for one in self.walkers], axis=1)
            for moment in np.unique(times_s):
                of_moment = np.flatnonzero(times_s == moment)
                self._add_people(places[of_moment[0]], of_moment, origins, rays, fan_normals, ranges, labels)
        return ranges, labels

    @staticmethod
    def _add_people(places, scans, origins, rays, fan_normals, ranges, labels) -> None:
        """Enter people who stand at places (W, 2) into the ranges of some scans."""
        places = places[np.linalg.norm(places - origins[scans[0], :2], axis=1) > _POLITE_M]
        people = np.column_stack([places, np.tile((0.0, 0.0, 0.0, _TALL_M, _GIRTH_M), (len(places), 1))])
        seen, _ = cast_scans(origins[scans], rays[scans], fan_normals[scans], np.empty((0, 3, 3)), people)
        nearer = seen < ranges[scans]
        ranges[scans] = np.where(nearer, seen, ranges[scans])
        labels[scans] = np.where(nearer, NO_PLANE, labels[scans])
