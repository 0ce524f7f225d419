"""A 2D world of segments and circles, random rooms and corridors, a ray caster, and what lines are judged by there."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spplanes import LineConfig, ScanLine


class World(NamedTuple):
    """What a 2D laser sees: straight walls, shape (K, 2, 2), and pillars as x, y, radius, shape (C, 3), m."""

    segments: np.ndarray
    circles: np.ndarray


class Truth(NamedTuple):
    """One noise-free scan: the range of each beam, m, NaN = nothing hit, and the segment that it hit, (B,) both; -1 =
    nothing, -2 and below = circle."""

    ranges: np.ndarray
    hits: np.ndarray


def cast(world: World, angles: np.ndarray, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Truth:
    """Intersect the beams of a laser at `pose` (x, y, theta) with the world."""
    ray = np.column_stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])))
    to_walls, to_pillars = _segment_ranges(world.segments, ray, pose[:2]), _circle_ranges(world.circles, ray, pose[:2])
    distances = np.concatenate((to_walls, to_pillars), axis=1)
    nearest = np.argmin(distances, axis=1)
    ranges = distances[np.arange(angles.size), nearest]
    n_segments = len(world.segments)
    hits = np.where(nearest < n_segments, nearest, -2 - (nearest - n_segments))
    return Truth(np.where(np.isfinite(ranges), ranges, np.nan), np.where(np.isfinite(ranges), hits, -1))


def _segment_ranges(segments: np.ndarray, ray: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    start = segments[:, 0] - origin
    along = segments[:, 1] - segments[:, 0]
    cross = ray[:, None, 0] * along[None, :, 1] - ray[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        share = (start[None, :, 0] * ray[:, None, 1] - start[None, :, 1] * ray[:, None, 0]) / cross
    return np.where((np.abs(cross) > 1e-12) & (distance > 1e-9) & (share >= 0) & (share <= 1), distance, np.inf)


def _circle_ranges(circles: np.ndarray, ray: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    centre = circles[:, :2] - origin
    along = ray @ centre.T
    chord = circles[:, 2] ** 2 - ((centre**2).sum(axis=1) - along**2)
    distance = along - np.sqrt(np.maximum(chord, 0.0))
    return np.where((chord > 0) & (distance > 0), distance, np.inf)


def polygon(corners: list[tuple[float, float]]) -> np.ndarray:
    """The closed polygon's sides, shape (K, 2, 2)."""
    points = np.array(corners, dtype=float)
    return np.stack((points, np.roll(points, -1, axis=0)), axis=1)


def box(x: float, y: float, width: float, height: float, theta: float = 0.0) -> np.ndarray:
    """Sides of a rectangle about (x, y), shape (4, 2, 2)."""
    half = 0.5 * np.array([(-width, -height), (width, -height), (width, height), (-width, height)])
    c, s = np.cos(theta), np.sin(theta)
    return polygon([tuple(p) for p in half @ np.array([(c, s), (-s, c)]) + (x, y)])


def random_room(rng: np.random.Generator) -> tuple[World, tuple[float, float, float]]:
    """A room of four to six walls, some not square, with boxes and pillars in it; and a pose inside."""
    width, height = rng.uniform(3, 10, 2)
    slant = rng.uniform(-0.1, 0.1, 4) * min(width, height)
    corners = [(-slant[0], 0), (width, slant[1]), (width + slant[2], height), (0, height + slant[3])]
    if rng.random() < 0.5:
        corners.insert(2, (width + slant[2] + rng.uniform(0.05, 0.3) * width, height * rng.uniform(0.3, 0.7)))
    pose = (rng.uniform(0.25, 0.75) * width, rng.uniform(0.25, 0.75) * height, rng.uniform(-np.pi, np.pi))
    segments = np.concatenate([polygon(corners), *_boxes(rng, width, height, pose)])
    return World(segments, _pillars(rng, width, height, pose)), pose


def _clear(rng, width: float, height: float, pose, radius: float) -> tuple[float, float]:
    while True:
        x, y = rng.uniform(0.15, 0.85) * width, rng.uniform(0.15, 0.85) * height
        if np.hypot(x - pose[0], y - pose[1]) > radius + 0.3:
            return x, y


def _boxes(rng, width, height, pose) -> list[np.ndarray]:
    sizes = (rng.uniform(0.3, 1.0, 2) for _ in range(rng.integers(0, 3)))
    return [box(*_clear(rng, width, height, pose, 0.8), *size, rng.uniform(0, np.pi)) for size in sizes]


def _pillars(rng, width, height, pose) -> np.ndarray:
    radii = (rng.uniform(0.03, 0.4) for _ in range(rng.integers(0, 5)))
    return np.array([(*_clear(rng, width, height, pose, radius), radius) for radius in radii]).reshape(-1, 3)


def random_corridor(rng: np.random.Generator) -> tuple[World, tuple[float, float, float]]:
    """A corridor with recessed doors on both sides, an end wall, chair legs; and a pose inside."""
    length, width, recess = rng.uniform(8, 30), rng.uniform(1.5, 3), rng.uniform(0.08, 0.3)
    walls = []
    for side, depth in ((0.0, -recess), (width, width + recess)):
        x = -3.0
        while x < length:
            wall, door = rng.uniform(1.0, 5.0), rng.uniform(0.8, 1.2)
            points = [(x, side), (x + wall, side), (x + wall, depth), (x + wall + door, depth), (x + wall + door, side)]
            walls += [np.array([(a, b)]) for a, b in pairwise(points)]
            x += wall + door
    walls.append(np.array([[(length, -1.0), (length, width + 1.0)]]))
    pose = (rng.uniform(0, 3), rng.uniform(0.3, 0.7) * width, rng.normal(0, 0.5))
    legs = [(rng.uniform(1, length), rng.uniform(0.1, 0.9) * width, 0.02) for _ in range(rng.integers(0, 6))]
    legs = [leg for leg in legs if np.hypot(leg[0] - pose[0], leg[1] - pose[1]) > 0.4]
    return World(np.concatenate(walls), np.array(legs).reshape(-1, 3)), pose


def true_line(segment: np.ndarray, pose: tuple[float, float, float]) -> tuple[float, float]:
    """(alpha, rho) of a wall in the frame of a laser at `pose`."""
    along = segment[1] - segment[0]
    normal = np.array((-along[1], along[0])) / np.hypot(*along)
    rho = normal @ (segment[0] - pose[:2])
    if rho < 0:
        normal, rho = -normal, -rho
    return np.arctan2(normal[1], normal[0]) - pose[2], rho


def nees(line: ScanLine, truth: tuple[float, float]) -> float:
    """Normalised error squared of (alpha, rho), 2 dof."""
    turn = (line.alpha - truth[0] + np.pi) % (2 * np.pi) - np.pi
    error = np.array((turn, line.rho - truth[1]))
    return float(error @ np.linalg.solve(line.covariance, error))


def wall_of_segment(world: World) -> np.ndarray:
    """For each segment the first one it is collinear with: pieces of one infinite line are one wall, shape (K,)."""
    lines = np.array([true_line(segment, (1e3, 2e3, 0.0)) for segment in world.segments])
    same = np.abs(lines[:, None] - lines[None]).max(axis=2) < 1e-7
    return np.argmax(same, axis=1)


def walls_hit(world: World, truth: Truth) -> np.ndarray:
    """Wall hit by each beam, shape (B,); negative where no wall is."""
    walls = wall_of_segment(world)
    return np.where(truth.hits >= 0, walls[np.maximum(truth.hits, 0)], truth.hits)


def detectable_runs(
    walls: np.ndarray, angles: np.ndarray, alphas: dict[int, tuple[float, float]], sigma: float, config: LineConfig
) -> list[np.ndarray]:
    """Runs of neighbouring beams on one wall that any extraction with `config` ought to report.

    At least twice `min_points` beams, and with exactly these beams both limits of `config` on what a line may be
    (`max_turning`, `max_nonlinearity`) would be met with half to spare.
    """
    runs = np.split(np.arange(walls.size), np.flatnonzero(np.diff(walls)) + 1)
    return [
        run
        for run in runs
        if run.size >= 2 * config.min_points
        and walls[run[0]] >= 0
        and _well_defined(angles[run], *alphas[int(walls[run[0]])], sigma, config)
    ]


def _well_defined(angles: np.ndarray, alpha: float, rho: float, sigma: float, config: LineConfig) -> bool:
    t, c = rho * np.tan(angles - alpha), np.cos(angles - alpha)
    half = 0.5 * np.ptp(t)
    along = (t - t.mean()) / half
    rows = np.column_stack((np.ones(t.size), along, along**2)) / (c * sigma)[:, None]
    arc_sigma = 4.0 * np.sqrt(np.linalg.inv(rows.T @ rows)[2, 2]) / half
    cov = np.linalg.inv(rows[:, :2].T @ rows[:, :2])
    shift, turn = cov[0, 0] - cov[0, 1] ** 2 / cov[1, 1], cov[1, 1] / half**2
    bend = 0.5 * rho * turn / np.sqrt(shift)
    return 3.0 * arc_sigma < 0.5 * config.max_turning and bend < 0.5 * config.max_nonlinearity


@dataclass
class Score:
    """Counts over many scans. See `add_scan` for what is true and what is false."""

    detectable: int = 0
    found: int = 0
    lines: int = 0
    false: int = 0
    nees: list[float] = field(default_factory=list)
    lost_beams: list[float] = field(default_factory=list)
    excess_beams: list[float] = field(default_factory=list)

    def add_scan(self, world: World, pose, truth: Truth, lines: list[ScanLine], angles, sigma, config) -> None:
        """Compare the lines of one scan with what the beams hit.

        A line is true when at least 80 % of its beams hit one wall, its (alpha, rho) is within chi2 = 27.6 (one in a
        million) of that wall's, and no better line covers the same run of beams (a wall in two pieces counts as one
        true and one false line). A detectable run is found when one true line holds at least 70 % of its beams.
        """
        walls = walls_hit(world, truth)
        alphas = {k: true_line(world.segments[k], pose) for k in np.unique(walls[walls >= 0])}
        runs = detectable_runs(walls, angles, alphas, sigma, config)
        owners: dict[int, list[ScanLine]] = {}
        self.lines += len(lines)
        for line in lines:
            ids, counts = np.unique(walls[line.indices], return_counts=True)
            wall = int(ids[np.argmax(counts)])
            error = nees(line, alphas[wall]) if wall >= 0 else np.inf
            if counts.max() < 0.8 * line.indices.size or error > 27.6:
                self.false += 1
                continue
            self.nees.append(error)
            owners.setdefault(wall, []).append(line)
        for run in runs:
            shares = [np.isin(run, line.indices).mean() for line in owners.get(int(walls[run[0]]), [])]
            self.detectable += 1
            self.found += bool(shares) and max(shares) >= 0.7
            self.false += sum(share > 0.0 for share in shares) - bool(shares and max(shares) > 0.0)
            if shares and max(shares) >= 0.7:
                line = owners[int(walls[run[0]])][int(np.argmax(shares))]
                self.lost_beams.append(run.size * (1.0 - max(shares)))
                self.excess_beams.append(np.sum(walls[line.indices] != walls[run[0]]))
