"""What extracted lines are judged by: the walls of the world they were seen in."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from spplanes import LineConfig, ScanLine
from tests.spplanes.lines.line_world import Truth, World


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
    rows = (
        np.column_stack((np.ones(t.size), (t - t.mean()) / half, ((t - t.mean()) / half) ** 2)) / (c * sigma)[:, None]
    )
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
