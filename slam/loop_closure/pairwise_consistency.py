"""Loop closure: which of several proposed closures agree with one another and the way between them (PCM)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse
from slam.registration.submaps import PlanarPose
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Proposal:
    """A closure that one comparison of submaps proposes, of a keyframe and an older one."""

    keyframe: int
    old_keyframe: int
    pose: PlanarPose
    """The newer one in the frame of the old one."""
    log_odds: float
    """Log of the probability of this against all else."""
    way_m: float
    """Length of the way to the newer keyframe, m."""

    def delta_by(self, poses: FloatArray) -> FloatArray:
        """(x, y, theta) of the newer one from the old one as poses (N, 4, 4) of all keyframes have it, shape (3,)."""
        return planar_delta(inverse(poses[self.old_keyframe]) @ poses[self.keyframe])

    def offset_m(self, poses: FloatArray) -> float:
        """How far it is from there, m."""
        return float(np.linalg.norm((self.delta_by(poses) - self.pose.delta)[:2]))


def loop_chi2(first: Proposal, second: Proposal, newer: PlanarPose, older: PlanarPose) -> float:
    """Chi2, 3 dof, of the loop over two closures and the ways between: `newer` and `older`, from first to second.

    References:
        Mangelson et al., "Pairwise Consistent Measurement Set Maximization", ICRA 2018.
    """
    return (first.pose @ newer).chi2(older @ second.pose)


def agree(chi2: float, significance: float) -> bool:
    """Whether two closures pass for consistent: of those that are, a share of `significance` does not."""
    return chi2 <= float(chdtri(3, significance))


def joint_log_odds(group: Sequence[Proposal], window_m: float) -> float:
    """Log odds of closures that agree, each counted by the share of what it saw that the one before did not see.

    That they agree, which closures that are wrong seldom do, comes on top of it and is not counted.
    """
    ordered = _in_order(group)
    return float(sum(share * one.log_odds for share, one in zip(_news(ordered, window_m), ordered, strict=True)))


def counted_once(group: Sequence[Proposal], window_m: float, every_m: float, closed_m: float) -> list[Proposal]:
    """Closures that agree with covariances that count once what several saw; of one look at least `every_m` is news.

    `closed_m`: length of the way to the newest closure so far, which may have seen some of it already; -inf: none.
    """
    ordered = _in_order(group)
    shares = np.array(_news(ordered, window_m))
    shares[0] = (ordered[0].way_m - closed_m) / window_m
    shares = np.clip(shares, min(every_m / window_m, 1.0), 1.0).tolist()
    return [
        replace(one, pose=replace(one.pose, covariance=one.pose.covariance / share))
        for share, one in zip(shares, ordered, strict=True)
    ]


def _in_order(group: Sequence[Proposal]) -> list[Proposal]:
    """By the way to them, of one look the likeliest first."""
    return sorted(group, key=lambda one: (one.way_m, -one.log_odds))


def _news(ordered: Sequence[Proposal], window_m: float) -> list[float]:
    """The share of what each saw that the one before did not see."""
    return [1.0, *(min((b.way_m - a.way_m) / window_m, 1.0) for a, b in pairwise(ordered))]


def maximal_cliques(agreeing: np.ndarray) -> list[list[int]]:
    """All maximal sets of members that agree two by two, each ascending; `agreeing` is symmetric, shape (N, N), bool.

    References:
        Bron and Kerbosch, Algorithm 457, CACM 1973, with pivoting.
    """
    near = [set(np.flatnonzero(row).tolist()) - {index} for index, row in enumerate(agreeing)]
    found: list[list[int]] = []

    def grow(clique: set[int], open_: set[int], done: set[int]) -> None:
        if not open_ and not done:
            found.append(sorted(clique))
            return
        pivot = max(sorted(open_ | done), key=lambda one: len(near[one] & open_))
        for one in sorted(open_ - near[pivot]):
            grow(clique | {one}, open_ & near[one], done & near[one])
            open_, done = open_ - {one}, done | {one}

    grow(set(), set(range(len(near))), set())
    return sorted(found)
