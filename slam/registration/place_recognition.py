"""Place recognition: a place found again by the constellation of its walls, with no idea of the pose between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from slam.geometry.frames import planar_transform
from slam.registration._place_kernels import WALL
from slam.registration._place_search import MAX_WALLS, MatchedMotion, Search
from spplanes import ScanLine
from spplanes._check import FloatArray

#: Planes that lean more than this from the vertical are no walls: sine of the lean.
MAX_LEAN = 0.2


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

    verdict: Literal["closure", "ambiguous", "unobservable"]
    """closure: one place, fixed in all directions; ambiguous: another pose explains the walls about as well;
    unobservable: the matched walls are parallel, but for so few that these may agree by chance."""
    pairs: np.ndarray
    """Matched walls as (index in a, index in b), shape (K, 2)."""
    b_T_a: FloatArray
    """Motion that takes a's coordinates to b's, shape (4, 4)."""
    covariance: FloatArray
    """Covariance of its (x, y, theta), additive, shape (3, 3)."""
    chi2: float
    """Sum of the squared normalised errors of (alpha, rho) of all pairs at the best motion."""
    n_dof: int
    """Degrees of freedom of `chi2`."""
    evidence: float
    """Log of how much better the walls that did not define the motion agree than by chance."""
    rival_evidence: float
    """The same for the best motion that differs; -inf without one."""

    by_walls: FloatArray | None = None
    """Covariance of the motion by the matched walls alone, where more was known of it; shape (3, 3)."""


def match_constellations(
    a: Sequence[ScanLine | Wall],
    b: Sequence[ScanLine | Wall],
    *,
    significance: float = 1e-3,
    min_matches: int = 4,
    min_overlap: float = 0.3,
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
        min_matches: fewest walls of a match, >= 3; walls in line with one another count once.
        min_overlap: share of the shorter of two walls that the other must cover, in [0, 1].

    Returns:
        The match, or None. Only `verdict == "closure"` may close a loop. The same input gives the same match.

    Raises:
        ValueError: a parameter out of its range.
    """
    _check(significance, min_matches, min_overlap)
    order_a, walls_a = _as_rows(a)
    order_b, walls_b = _as_rows(b)
    if min(len(order_a), len(order_b)) < 2:
        return None
    search = Search(walls_a, walls_b, significance, min_matches, min_overlap)
    best = search.best_motion() or search.best_parallel_motion()
    return None if best is None else _as_match(best, order_a, order_b)


def match_near(
    a: Sequence[ScanLine | Wall],
    b: Sequence[ScanLine | Wall],
    pose: FloatArray,
    covariance: FloatArray,
    *,
    significance: float = 1e-3,
    min_overlap: float = 0.3,
) -> ConstellationMatch | None:
    """Walls of two views that are the same, where the motion between them is known.

    Args:
        a, b, significance, min_overlap: as in `match_constellations`.
        pose: (x, y, theta) of b_T_a, shape (3,).
        covariance: of its error, shape (3, 3).

    Returns:
        The match, its motion that of pose and walls together; None where the walls contradict the pose or each other,
        or none is the same.
    """
    _check(significance, 3, min_overlap)
    order_a, walls_a = _as_rows(a)
    order_b, walls_b = _as_rows(b)
    if min(len(order_a), len(order_b)) < 1:
        return None
    search = Search(walls_a, walls_b, significance, 1, min_overlap)
    motion = search.motion_near(pose, covariance)
    if motion is None:
        return None
    return replace(_as_match(motion, order_a, order_b), by_walls=search.covariance_of(motion))


def _check(significance: float, min_matches: int, min_overlap: float) -> None:
    if not 0.0 < significance < 0.5:
        raise ValueError(f"significance: expected a probability in (0, 0.5), got {significance}")
    if min_matches < 3:
        raise ValueError(f"min_matches: expected at least 3, got {min_matches}")
    if not 0.0 <= min_overlap <= 1.0:
        raise ValueError(f"min_overlap: expected a share in [0, 1], got {min_overlap}")


def _as_rows(walls: Sequence[ScanLine | Wall]) -> tuple[np.ndarray, FloatArray]:
    """Indices of the walls that take part, longest first, and their rows for the kernels, shape (N, 7)."""
    rows = np.empty((len(walls), WALL))
    for row, wall in zip(rows, walls, strict=True):
        along = wall.endpoints @ np.array((-np.sin(wall.alpha), np.cos(wall.alpha)))
        (v_alpha, cov), (_, v_rho) = wall.covariance.tolist()
        row[:] = wall.alpha, wall.rho, v_alpha, cov, v_rho, along.min(), along.max()
    order = np.argsort(rows[:, 5] - rows[:, 6], kind="stable")[:MAX_WALLS]
    return order, rows[order]


def _as_match(motion: MatchedMotion, order_a: np.ndarray, order_b: np.ndarray) -> ConstellationMatch:
    """The match with the caller's indices."""
    pairs = np.array(sorted((int(order_a[i]), int(order_b[j])) for i, j in motion.pairs))
    return ConstellationMatch(
        motion.verdict, pairs, planar_transform(*motion.pose), motion.covariance, motion.chi2, motion.n_dof,
        motion.evidence, motion.rival,
    )  # fmt: skip
