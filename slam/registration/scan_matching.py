"""Correlative scan matching: the posterior of one view's pose in another, by all returns and all free space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label
from scipy.special import gamma

from slam.frontend.occupancy import CELL_M, LEVELS, Raster
from slam.frontend.occupancy._kernels import score_motions
from spplanes._check import FloatArray

#: Motions this much less likely than the best, as a log, do not count.
_NEGLIGIBLE = 10.0
#: Degrees of freedom of the prior's Student t distribution: an estimate may be worse than it says.
_TAIL = 3.0
#: Prior probability that the views have nothing in common.
_NOTHING = 0.5
#: Most blocks kept from one level to the next; it bounds the time where nothing is known.
_MOST_BLOCKS = 30000


@dataclass(frozen=True, eq=False)
class Relocation:
    """The best mode of the posterior of b_T_a."""

    pose: FloatArray
    """Mean (x, y, theta) of the mode, shape (3,)."""
    covariance: FloatArray
    """Its covariance, shape (3, 3)."""
    evidence: float
    """Log of how much better the mode explains the returns than views that have nothing in common."""
    share: float
    """Probability of the mode; the rest are other modes and having nothing in common."""


def relocate(a: Raster, b: Raster, guess: FloatArray, covariance: FloatArray, reach: FloatArray) -> Relocation:
    """Search b_T_a around a guess with all its probable errors.

    Every motion within `reach` of the guess is a hypothesis: the prior is a Student t about the guess, the likelihood
    that of all returns of one view in the raster of the other and back, where what was not seen says nothing. Blocks of
    motions are split as long as a bound of their likelihood is not negligible.

    Args:
        a, b: the views, each in its own frame.
        guess: (x, y, theta) of b_T_a, shape (3,).
        covariance: of its error, shape (3, 3).
        reach: half sides of the box searched, (x, y, theta), shape (3,).

    References:
        Olson, "Real-time correlative scan matching", ICRA 2009; Hess et al., "Real-time loop closure in 2D LIDAR SLAM",
        ICRA 2016, for the bounds.
    """
    turn = CELL_M / max(_radius(a), _radius(b))
    first = int(np.clip(np.ceil(np.log2(max(reach[:2].max(), CELL_M) / (2.0 * CELL_M))), 0, LEVELS - 1))
    blocks = _first_blocks(reach, turn, first)
    information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    steepest = float(np.sqrt(np.linalg.eigvalsh(information[:2, :2])[-1]))
    prior = -np.log(max(prior_mass(covariance) / (CELL_M**2 * turn), 1.0)) + np.log1p(-_NOTHING)
    best, scores = float(np.log(_NOTHING)), np.empty(0)
    for level in range(first, -1, -1):
        offsets = blocks * (0.5 * CELL_M, 0.5 * CELL_M, turn)
        half = 0.5 * (2**level - 1) * CELL_M
        slack = _STEEPEST * np.sqrt(2.0) * half * steepest
        scores = prior + log_student(offsets, information) + _fit(a, b, guess + offsets, level)
        if level:
            top = _largest(scores, _N_TRIED)
            tried = prior + log_student(offsets[top], information) + _fit(a, b, guess + offsets[top], 0)
            best = max(best, float(tried.max(initial=best)))
        else:
            best = max(best, float(scores.max(initial=best)))
        kept = np.flatnonzero(scores + slack >= best - _NEGLIGIBLE)
        if kept.size > _MOST_BLOCKS:
            kept = kept[_largest(scores[kept], _MOST_BLOCKS)]
        blocks, scores = blocks[kept], scores[kept]
        blocks = split(blocks, level) if level else blocks
    return _best_mode(guess, blocks, scores, turn)


#: Steepest slope of the log of the prior by its Mahalanobis distance, for `_TAIL` and three dimensions.
_STEEPEST = 0.5 * (_TAIL + 3.0) / np.sqrt(_TAIL)
#: Blocks of each level whose middle is tried out to have a likelihood to compare bounds with.
_N_TRIED = 200


def _largest(values: FloatArray, count: int) -> np.ndarray:
    """Indices of the largest values, in no order."""
    return np.arange(values.size) if values.size <= count else np.argpartition(-values, count)[:count]


def _radius(view: Raster) -> float:
    """Distance beyond which a quarter of the points lie: what a small turn moves by a cell there, m."""
    return float(np.quantile(np.linalg.norm(view.points, axis=1), 0.75)) + CELL_M


def _first_blocks(reach: FloatArray, turn: float, level: int) -> np.ndarray:
    """Middles of the blocks of a level that cover the box, as half cells and turns from the guess, shape (M, 3)."""
    side = 2 ** (level + 1)  # in half cells
    counts = np.ceil(2.0 * reach[:2] / (0.5 * CELL_M * side)).astype(int)
    x, y = (side * (np.arange(n) - 0.5 * (n - 1)) for n in counts)
    turns = np.arange(-int(np.ceil(reach[2] / turn)), int(np.ceil(reach[2] / turn)) + 1)
    grid = np.stack(np.meshgrid(x, y, turns, indexing="ij"), axis=-1)
    return grid.reshape(-1, 3).astype(np.float64)


def split(blocks: np.ndarray, level: int) -> np.ndarray:
    """The four blocks of the level below in each."""
    step = 2 ** (level - 1)  # half the side of a child in half cells
    corners = np.array([(i, j, 0) for i in (-step, step) for j in (-step, step)], dtype=np.float64)
    return (blocks[:, None, :] + corners).reshape(-1, 3)


def _fit(a: Raster, b: Raster, motions: FloatArray, level: int) -> FloatArray:
    """Log likelihood ratio of each motion (M, 3), or its bound in the block of this level about it, shape (M,)."""
    return score_motions(
        motions, CELL_M, a.points, a.weight, b.bound(level), b.origin,
        b.points, b.weight, a.bound(level, turned=True), a.origin,
    )  # fmt: skip


def log_student(offsets: FloatArray, information: FloatArray) -> FloatArray:
    """Log of the prior's density relative to that at the guess, shape (M,)."""
    squared = np.einsum("ni,ij,nj->n", offsets, information, offsets)
    return -0.5 * (_TAIL + 3.0) * np.log1p(squared / _TAIL)


def prior_mass(covariance: FloatArray) -> float:
    """Integral of that relative density over all motions, m^2 rad."""
    constant = gamma(0.5 * _TAIL) * (_TAIL * np.pi) ** 1.5 / gamma(0.5 * (_TAIL + 3.0))
    return float(constant * np.sqrt(np.linalg.det(covariance)))


def log_sum(values: FloatArray) -> float:
    """Log of the sum of exponentials."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


def _best_mode(guess: FloatArray, blocks: np.ndarray, scores: FloatArray, turn: float) -> Relocation:
    """The set of neighbouring motions with the most probability."""
    nothing = np.log(_NOTHING)
    if not blocks.size:
        return Relocation(guess, np.eye(3), -np.inf, 0.0)
    cells = np.round((blocks - blocks.min(axis=0)) * (0.5, 0.5, 1.0)).astype(np.int64)
    present = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    present[tuple(cells.T)] = True
    labels, _ = label(present, structure=np.ones((3, 3, 3)))  # type: ignore[misc]
    modes = np.asarray(labels)[tuple(cells.T)]
    masses = {int(mode): log_sum(scores[modes == mode]) for mode in np.unique(modes)}
    best = max(masses, key=lambda mode: masses[mode])
    inside = modes == best
    offsets = blocks[inside] * (0.5 * CELL_M, 0.5 * CELL_M, turn)
    weights = np.exp(scores[inside] - masses[best])
    mean = weights @ offsets
    spread = np.einsum("n,ni,nj->ij", weights, offsets - mean, offsets - mean)
    grid = np.diag((CELL_M**2, CELL_M**2, turn**2)) / 12.0
    total = log_sum(np.array([*masses.values(), nothing]))
    return Relocation(guess + mean, spread + grid, masses[best] - nothing, float(np.exp(masses[best] - total)))
