"""Search of place recognition; `slam.registration.place_recognition` is its front."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from slam.frontend.odometry import difference
from slam.registration._place_kernels import fit_pose, rank_hypotheses, score_table
from spplanes._check import FloatArray

#: Walls that differ less in direction are parallel: they do not fix a place between them, rad.
PARALLEL = np.radians(15.0)
#: Standard deviation of a pose of which nothing is known: m, m, rad.
UNKNOWN = np.array((1e3, 1e3, 1e2))
#: Hypotheses that are worked out to the end.
N_REFINED = 24
#: These bound the time: walls of a constellation (the longest are taken), hypotheses scored, and tried for corridors.
MAX_WALLS = 40
MAX_HYPOTHESES = 4000
MAX_PARALLEL = 48


@dataclass(frozen=True, eq=False)
class MatchedMotion:
    """A motion, worked out: indices are rows."""

    pose: FloatArray
    covariance: FloatArray
    pairs: list[tuple[int, int]]
    chi2: float
    n_dof: int
    evidence: float
    verdict: Literal["closure", "ambiguous", "unobservable"] = "closure"
    rival: float = -np.inf


class Search:
    """The search between two sets of rows; see `match_constellations`."""

    def __init__(self, a: FloatArray, b: FloatArray, significance: float, min_matches: int, min_overlap: float) -> None:
        self.a, self.b = a, b
        self.significance, self.min_matches, self.min_overlap = significance, min_matches, min_overlap
        self.gate = float(chdtri(2, significance))
        self.densities = _densities(b)
        self.no_prior = np.diag(UNKNOWN**-2.0)
        self.in_line_a, self.in_line_b = _in_line(a, self.gate), _in_line(b, self.gate)

    def best_motion(self) -> MatchedMotion | None:
        """The motion with the most evidence of those that two walls in different directions fix."""
        pairs = self._correspondences()
        angle_gate = float(chdtri(1, self.significance))
        members, poses, scores = rank_hypotheses(
            self.a, self.b, self.densities, pairs, MAX_HYPOTHESES, self.no_prior, self.gate, angle_gate,
            np.sin(PARALLEL), self.min_overlap,
        )  # fmt: skip
        best = np.argsort(-scores, kind="stable")[:N_REFINED]
        motions = [self._work_out([tuple(pairs[k]) for k in members[h]], poses[h], self.no_prior) for h in best]
        return self._decide([motion for motion in motions if motion is not None], len(scores))

    def best_parallel_motion(self) -> MatchedMotion | None:
        """The motion of walls of one direction, such as a corridor's, that leaves open how far along them.

        What is known of that is that the two walls it starts from overlap.
        """
        motions = []
        for i, j in self._correspondences()[:MAX_PARALLEL]:
            wall, other = self.a[i], self.b[j]
            normal = np.array((np.cos(other[0]), np.sin(other[0])))
            along = np.array((-normal[1], normal[0]))
            shift = (other[1] - wall[1]) * normal + 0.5 * (other[5:].sum() - wall[5:].sum()) * along
            prior = self.no_prior.copy()
            prior[:2, :2] += 12.0 * np.outer(along, along) / (np.ptp(wall[5:]) + np.ptp(other[5:])) ** 2
            parallel = np.abs(np.sin(self.a[:, 0] - wall[0])) < np.sin(PARALLEL)
            motions.append(self._work_out([(i, j)], np.array((*shift, other[0] - wall[0])), prior, parallel))
        found = self._decide([motion for motion in motions if motion is not None], len(motions))
        return None if found is None else replace(found, verdict="unobservable")

    def motion_near(self, pose: FloatArray, covariance: FloatArray) -> MatchedMotion | None:
        """The motion about one that is known with a covariance, and the walls that are the same under it."""
        return self._work_out([], pose, np.asarray(np.linalg.inv(covariance), dtype=np.float64))

    def covariance_of(self, motion: MatchedMotion) -> FloatArray:
        """Covariance of a motion by its walls alone, large where they leave it open."""
        rows_a, rows_b = np.array(motion.pairs, dtype=np.int64).T
        return fit_pose(motion.pose, self.a[rows_a], self.b[rows_b], self.no_prior)[1]

    def _correspondences(self) -> np.ndarray:
        """All pairs of a wall of a and one of b, pairs of long walls first, shape (C, 2)."""
        pairs = np.array([(i, j) for i in range(len(self.a)) for j in range(len(self.b))])
        return pairs[np.argsort(pairs.sum(axis=1), kind="stable")]

    def _work_out(
        self, seeds: list, pose: FloatArray, prior: FloatArray, allowed: np.ndarray | None = None
    ) -> MatchedMotion | None:
        """Take the pair with the most evidence, estimate the motion anew, until none is left; `allowed` rows of a."""
        pairs, evidence, n_distinct = [(int(i), int(j)) for i, j in seeds], 0.0, len(seeds)
        start = pose
        while True:
            rows_a, rows_b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
            pose, covariance, chi2 = fit_pose(start, self.a[rows_a], self.b[rows_b], prior)
            table = score_table(pose, covariance, self.a, self.b, self.densities, self.gate, self.min_overlap)
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
        if n_distinct < self.min_matches or chi2 > chdtri(n_dof, self.significance):
            return None
        return MatchedMotion(pose, covariance, pairs, float(chi2), n_dof, evidence)

    def _decide(self, motions: list[MatchedMotion], n_tried: int) -> MatchedMotion | None:
        """The motion with the most evidence, if it is more than chance gives, and whether another one rivals it."""
        threshold = -np.log(self.significance)
        if not motions:
            return None
        best = max(motions, key=lambda motion: motion.evidence)
        if best.evidence < threshold + np.log(max(n_tried, 1)):
            return None
        rival = max((m.evidence for m in motions if _differ(best, m, self.gate)), default=-np.inf)
        if self._evidence_across(best) < threshold:
            return replace(best, verdict="unobservable", rival=rival)
        return replace(best, verdict="ambiguous" if best.evidence - rival < threshold else "closure", rival=rival)

    def _evidence_across(self, motion: MatchedMotion) -> float:
        """Evidence for the position in its weakest direction: of the walls across it, but for one that defines it."""
        weakest = np.linalg.eigh(motion.covariance[:2, :2])[1][:, 1]
        across = [
            abs(np.cos(self.b[j, 0]) * weakest[0] + np.sin(self.b[j, 0]) * weakest[1]) > np.sin(PARALLEL)
            for _, j in motion.pairs
        ]
        fixing = [pair for pair, is_across in zip(motion.pairs, across, strict=True) if is_across]
        known = [pair for pair, is_across in zip(motion.pairs, across, strict=True) if not is_across] + fixing[:1]
        evidence = 0.0
        for i, j in fixing[1:]:
            rows_a, rows_b = (np.array(side) for side in zip(*known, strict=True))
            pose, covariance, _ = fit_pose(motion.pose, self.a[rows_a], self.b[rows_b], self.no_prior)
            table = score_table(
                pose, covariance, self.a[[i]], self.b[[j]], self.densities[[j]], self.gate, self.min_overlap
            )
            if not self._follows(known, i, j):
                evidence += max(float(table[0, 0]), 0.0)
            known.append((i, j))
        return evidence

    def _follows(self, pairs: list[tuple[int, int]], i: int, j: int) -> bool:
        """True when a pair is no news: another one holds walls in line with both, such as those beside a door."""
        return any(self.in_line_a[i, k] and self.in_line_b[j, m] for k, m in pairs)


def _differ(motion: MatchedMotion, other: MatchedMotion, gate: float) -> bool:
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
    near = np.cos(walls[:, None, 0] - walls[None, :, 0]) > np.cos(PARALLEL)
    c, s = np.cos(walls[:, 0]), np.sin(walls[:, 0])
    feet = walls[:, 1, None] * np.stack((c, s), axis=1)
    ends = np.concatenate([feet + walls[:, k, None] * np.stack((-s, c), axis=1) for k in (5, 6)])
    across = ends @ np.stack((c, s))
    return near.sum(axis=1) / np.maximum(np.ptp(across, axis=0), 1.0)
