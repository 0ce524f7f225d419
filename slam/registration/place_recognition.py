"""Place recognition: a place found again by the constellation of its walls, with no idea of the pose between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from slam.frontend.odometry import difference
from slam.geometry.frames import planar_transform
from slam.registration._place_kernels import WALL, fit_pose, rank_hypotheses, score_table
from spplanes import ScanLine
from spplanes._check import FloatArray

#: Planes that lean more than this from the vertical are no walls: sine of the lean.
MAX_LEAN = 0.2
#: Walls that differ less in direction are parallel: they do not fix a place between them, rad.
_PARALLEL = np.radians(15.0)
#: Standard deviation of a pose of which nothing is known: m, m, rad.
_UNKNOWN = np.array((1e3, 1e3, 1e2))
#: The share of the shorter of two walls that the other must cover.
_OVERLAP = 0.3


@dataclass(frozen=True, eq=False)
class Wall:
    """A wall in the plane of motion, with the side it was seen from."""

    alpha: float
    """Direction of the normal from the free side into the wall, rad."""
    rho: float
    """x cos(alpha) + y sin(alpha) on the wall, m; negative where the origin is behind it."""
    covariance: FloatArray
    """Covariance of (alpha, rho), shape (2, 2)."""
    endpoints: FloatArray
    """Ends of what was seen of it, shape (2, 2), m."""

    @classmethod
    def from_plane(cls, normal: FloatArray, d: float, covariance: FloatArray, corners: FloatArray) -> Wall:
        """The wall of a plane that stands about upright, in a frame whose z axis is up.

        Args:
            normal: unit normal toward the free side, shape (3,).
            d: Hesse distance, m.
            covariance: of (normal, d), shape (4, 4).
            corners: of what was seen of it, shape (N, 3) or (N, 2), m.
        """
        level = max(float(np.hypot(normal[0], normal[1])), 1.0 - MAX_LEAN)
        by_hesse = np.zeros((2, 4))  # of (alpha, rho): the wall's normal points into it, the plane's out of it
        by_hesse[0, :2] = np.array((-normal[1], normal[0])) / level**2
        by_hesse[1, 3] = -1.0 / level
        alpha = float(np.arctan2(-normal[1], -normal[0]))
        along = corners[:, :2] @ np.array((-np.sin(alpha), np.cos(alpha)))
        ends = corners[[int(np.argmin(along)), int(np.argmax(along))], :2]
        return cls(alpha, -d / level, by_hesse @ covariance @ by_hesse.T, ends)


@dataclass(frozen=True, eq=False)
class ConstellationMatch:
    """Walls of two views that are the same under one rigid motion."""

    pose: FloatArray
    """(x, y, theta) of b_T_a, the motion that takes a's coordinates to b's, shape (3,)."""
    covariance: FloatArray
    """Its covariance, additive, shape (3, 3)."""
    pairs: np.ndarray
    """Matched walls as (index in a, index in b), shape (K, 2)."""
    chi2: float
    """Sum of the squared normalised errors of (alpha, rho) of all pairs at the best motion."""
    n_dof: int
    """Degrees of freedom of `chi2`."""
    evidence: float
    """Log of how much better the walls that did not define the motion agree than by chance."""
    verdict: Literal["closure", "ambiguous", "unobservable"] = "closure"
    """closure: one place, fixed in all directions; ambiguous: another pose explains the walls about as well;
    unobservable: the matched walls are parallel, but for so few that these may agree by chance."""
    rival_evidence: float = -np.inf
    """The evidence of the best motion that differs; -inf without one."""
    by_walls: FloatArray | None = None
    """Covariance of the motion by the matched walls alone, where more was known of it; shape (3, 3)."""

    @property
    def b_T_a(self) -> FloatArray:
        """The motion, shape (4, 4)."""
        return planar_transform(*self.pose)

    def of_walls(self, order_a: np.ndarray, order_b: np.ndarray) -> ConstellationMatch:
        """The same with the caller's indices in place of those of rows."""
        pairs = sorted((int(order_a[i]), int(order_b[j])) for i, j in self.pairs)
        return replace(self, pairs=np.array(pairs))


def match_constellations(
    a: Sequence[ScanLine | Wall],
    b: Sequence[ScanLine | Wall],
    *,
    significance: float = 1e-3,
) -> ConstellationMatch | None:
    """Find the largest set of walls that two views share under one unknown rigid motion in the plane.

    Two correspondences in different directions whose enclosed angles agree (chi2) define a motion with covariance. All
    other walls are compared under it: chi2 with 2 dof of (alpha, rho), the side, and the overlap of the extents. The
    best motions are then worked out: the pair with the most evidence is taken, the motion estimated anew, until none is
    left; the whole set must pass its joint chi2. The evidence of a pair is the log ratio of the density of its distance
    error to that of a wall of this direction being there by chance; directions give none, for buildings repeat theirs.

    Args:
        a: walls of one view; lines of one scan, or `Wall`s gathered in one frame.
        b: walls of the other.
        significance: probability of so strong a match by chance in as many hypotheses as were tried, in (0, 0.5).

    Returns:
        The match, or None. Only `verdict == "closure"` may close a loop. The same input gives the same match.

    Raises:
        ValueError: a significance out of its range.
    """
    if not 0.0 < significance < 0.5:
        raise ValueError(f"significance: expected a probability in (0, 0.5), got {significance}")
    order_a, walls_a = _as_rows(a)
    order_b, walls_b = _as_rows(b)
    if min(len(order_a), len(order_b)) < 2:
        return None
    search = _Search(walls_a, walls_b, significance, fewest=4)
    best = search.best_motion() or search.best_parallel_motion()
    return None if best is None else best.of_walls(order_a, order_b)


def match_near(
    a: Sequence[ScanLine | Wall],
    b: Sequence[ScanLine | Wall],
    pose: FloatArray,
    covariance: FloatArray,
    *,
    significance: float = 1e-3,
) -> ConstellationMatch | None:
    """Walls of two views that are the same, where the motion between them is known.

    Args:
        a, b, significance: as in `match_constellations`.
        pose: (x, y, theta) of b_T_a, shape (3,).
        covariance: of its error, shape (3, 3).

    Returns:
        The match, its motion that of pose and walls together; None where the walls contradict the pose or each other,
        or none is the same.
    """
    order_a, walls_a = _as_rows(a)
    order_b, walls_b = _as_rows(b)
    if min(len(order_a), len(order_b)) < 1:
        return None
    search = _Search(walls_a, walls_b, significance, fewest=1)
    motion = search.work_out([], pose, np.asarray(np.linalg.inv(covariance), dtype=np.float64))
    if motion is None:
        return None
    rows_a, rows_b = motion.pairs.T
    _, by_walls, _ = fit_pose(motion.pose, walls_a[rows_a], walls_b[rows_b], search.no_prior)
    return replace(motion.of_walls(order_a, order_b), by_walls=by_walls)


def _as_rows(walls: Sequence[ScanLine | Wall]) -> tuple[np.ndarray, FloatArray]:
    """Indices of the walls that take part, longest first, and their rows for the kernels, shape (N, 7)."""
    rows = np.empty((len(walls), WALL))
    for row, wall in zip(rows, walls, strict=True):
        along = wall.endpoints @ np.array((-np.sin(wall.alpha), np.cos(wall.alpha)))
        (v_alpha, cov), (_, v_rho) = wall.covariance.tolist()
        row[:] = wall.alpha, wall.rho, v_alpha, cov, v_rho, along.min(), along.max()
    order = np.argsort(rows[:, 5] - rows[:, 6], kind="stable")[:40]  # bounds the time
    return order, rows[order]


class _Search:
    """The search between two sets of rows, which it goes by; see `match_constellations`."""

    def __init__(self, a: FloatArray, b: FloatArray, significance: float, *, fewest: int) -> None:
        """With the fewest walls of a match, those in line with one another counted once."""
        self.a, self.b = a, b
        self.significance, self.fewest = significance, fewest
        self.gate = float(chdtri(2, significance))
        self.densities = _densities(b)
        self.no_prior = np.diag(_UNKNOWN**-2.0)
        self.in_line_a, self.in_line_b = _in_line(a, self.gate), _in_line(b, self.gate)

    def best_motion(self) -> ConstellationMatch | None:
        """The motion with the most evidence of those that two walls in different directions fix.

        4000 of these are scored at most, and 24 worked out to the end, which bounds the time.
        """
        pairs = self._correspondences()
        angle_gate = float(chdtri(1, self.significance))
        members, poses, scores = rank_hypotheses(
            self.a, self.b, self.densities, pairs, 4000, self.no_prior, self.gate, angle_gate,
            np.sin(_PARALLEL), _OVERLAP,
        )  # fmt: skip
        best = np.argsort(-scores, kind="stable")[:24]
        motions = [self.work_out([tuple(pairs[k]) for k in members[h]], poses[h], self.no_prior) for h in best]
        return self._decide(motions, len(scores))

    def best_parallel_motion(self) -> ConstellationMatch | None:
        """The motion of walls of one direction, such as a corridor's, that leaves open how far along them.

        What is known of that is that the two walls it starts from overlap.
        """
        motions = []
        for i, j in self._correspondences()[:48]:
            wall, other = self.a[i], self.b[j]
            normal = np.array((np.cos(other[0]), np.sin(other[0])))
            along = np.array((-normal[1], normal[0]))
            shift = (other[1] - wall[1]) * normal + 0.5 * (other[5:].sum() - wall[5:].sum()) * along
            prior = self.no_prior.copy()
            prior[:2, :2] += 12.0 * np.outer(along, along) / (np.ptp(wall[5:]) + np.ptp(other[5:])) ** 2
            parallel = np.abs(np.sin(self.a[:, 0] - wall[0])) < np.sin(_PARALLEL)
            motions.append(self.work_out([(i, j)], np.array((*shift, other[0] - wall[0])), prior, parallel))
        found = self._decide(motions, len(motions))
        return None if found is None else replace(found, verdict="unobservable")

    def _correspondences(self) -> np.ndarray:
        """All pairs of a wall of a and one of b, pairs of long walls first, shape (C, 2)."""
        pairs = np.array([(i, j) for i in range(len(self.a)) for j in range(len(self.b))])
        return pairs[np.argsort(pairs.sum(axis=1), kind="stable")]

    def work_out(
        self, seeds: list, pose: FloatArray, prior: FloatArray, allowed: np.ndarray | None = None
    ) -> ConstellationMatch | None:
        """Take the pair with the most evidence, estimate the motion anew, until none is left; `allowed` rows of a."""
        pairs, evidence, n_distinct = [(int(i), int(j)) for i, j in seeds], 0.0, len(seeds)
        start = pose
        while True:
            rows_a, rows_b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
            pose, covariance, chi2 = fit_pose(start, self.a[rows_a], self.b[rows_b], prior)
            table = score_table(pose, covariance, self.a, self.b, self.densities, self.gate, _OVERLAP)
            table[rows_a], table[:, rows_b] = -np.inf, -np.inf
            table[~allowed if allowed is not None else []] = -np.inf
            i, j = np.unravel_index(np.argmax(table), table.shape)
            if not table[i, j] > 0.0:
                break
            if not self._follows(pairs, int(i), int(j)):
                evidence += float(table[i, j])
                n_distinct += 1
            pairs.append((int(i), int(j)))
        n_dof = 2 * len(pairs) - (len(seeds) and (3 if allowed is None else 2))
        if n_distinct < self.fewest or chi2 > chdtri(n_dof, self.significance):
            return None
        return ConstellationMatch(pose, covariance, np.array(pairs), float(chi2), n_dof, evidence)

    def _decide(self, worked_out: list[ConstellationMatch | None], n_tried: int) -> ConstellationMatch | None:
        """The motion with the most evidence, if it is more than chance gives, and whether another one rivals it."""
        threshold = -np.log(self.significance)
        motions = [motion for motion in worked_out if motion is not None]
        if not motions:
            return None
        best = max(motions, key=lambda motion: motion.evidence)
        if best.evidence < threshold + np.log(max(n_tried, 1)):
            return None
        rival = max((m.evidence for m in motions if _differ(best, m, self.gate)), default=-np.inf)
        if self._evidence_across(best) < threshold:
            return replace(best, verdict="unobservable", rival_evidence=rival)
        is_rivalled = best.evidence - rival < threshold
        return replace(best, verdict="ambiguous" if is_rivalled else "closure", rival_evidence=rival)

    def _evidence_across(self, motion: ConstellationMatch) -> float:
        """Evidence for the position in its weakest direction: of the walls across it, but for one that defines it."""
        weakest = np.linalg.eigh(motion.covariance[:2, :2])[1][:, 1]
        directions = self.b[motion.pairs[:, 1], 0]
        across = np.abs(np.cos(directions) * weakest[0] + np.sin(directions) * weakest[1]) > np.sin(_PARALLEL)
        fixing, evidence = motion.pairs[across], 0.0
        known = [*motion.pairs[~across], *fixing[:1]]
        for i, j in fixing[1:]:
            rows_a, rows_b = np.array(known).T
            pose, covariance, _ = fit_pose(motion.pose, self.a[rows_a], self.b[rows_b], self.no_prior)
            table = score_table(pose, covariance, self.a[[i]], self.b[[j]], self.densities[[j]], self.gate, _OVERLAP)
            if not self._follows(known, i, j):
                evidence += max(float(table[0, 0]), 0.0)
            known.append((i, j))
        return evidence

    def _follows(self, pairs: list[tuple[int, int]], i: int, j: int) -> bool:
        """True when a pair is no news: another one holds walls in line with both, such as those beside a door."""
        return any(self.in_line_a[i, k] and self.in_line_b[j, m] for k, m in pairs)


def _differ(motion: ConstellationMatch, other: ConstellationMatch, gate: float) -> bool:
    """True when two motions are not the same within their covariances."""
    error = difference(other.pose, motion.pose)
    return float(error @ np.linalg.solve(motion.covariance + other.covariance, error)) > gate


def _in_line(walls: FloatArray, gate: float) -> np.ndarray:
    """For each two walls of a view whether they may lie on one line, shape (N, N)."""
    still, certain = np.zeros(3), np.zeros((3, 3))
    anywhere = walls.copy()
    anywhere[:, 5], anywhere[:, 6] = -np.inf, np.inf
    return score_table(still, certain, anywhere, anywhere, np.ones(len(walls)), gate, 0.0) > -np.inf


def _densities(walls: FloatArray) -> FloatArray:
    """Walls of about its direction per metre of the view across it, for each wall, shape (N,): what chance offers."""
    near = np.cos(walls[:, None, 0] - walls[None, :, 0]) > np.cos(_PARALLEL)
    c, s = np.cos(walls[:, 0]), np.sin(walls[:, 0])
    feet = walls[:, 1, None] * np.stack((c, s), axis=1)
    ends = np.concatenate([feet + walls[:, k, None] * np.stack((-s, c), axis=1) for k in (5, 6)])
    across = ends @ np.stack((c, s))
    return near.sum(axis=1) / np.maximum(np.ptp(across, axis=0), 1.0)
