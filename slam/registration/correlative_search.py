"""Correlative search: every place where one submap may lie in another, by branch and bound, with its probability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.special import expit, gamma

from slam.frontend.occupancy.raster import CELL_M, Raster
from slam.registration._search_kernels import peaks_of, score_by_heading
from spplanes._check import FloatArray

#: Tables are kept as integers of this unit, nats.
_UNIT = 0.05
#: Motions this much less likely than the best, as a log, do not count: 1e-3.
_NEGLIGIBLE = 7.0
#: Degrees of freedom of the prior's Student t distribution: an estimate may be worse than it says.
_TAIL = 3.0
#: Steepest slope of the log of the prior by its Mahalanobis distance, for `_TAIL` and three dimensions.
_STEEPEST = 0.5 * (_TAIL + 3.0) / np.sqrt(_TAIL)
#: Prior probability that the submaps have nothing in common.
_NOTHING = 0.5
#: Two peaks are two modes when the lower rises by so many nats above the saddle between: less is one look's chance.
_PROMINENCE = 1.0
#: Peaks nearer to each other are one place, m: a submap's own drift parts them, walls are drawn twice in it.
_ONE_PLACE_M = 0.3
#: Blocks of motions have sides of 2^level cells; the highest level, and of boxes that would have too many blocks there.
_TOP_LEVEL, _HIGHEST_LEVEL = 4, 7
#: Most blocks kept from one level to the next.
_MOST_BLOCKS = 10_000


@dataclass(frozen=True, eq=False)
class Mode:
    """One place where a submap may lie in the other."""

    pose: FloatArray
    """Mean (x, y, theta) of b_T_a, shape (3,)."""
    covariance: FloatArray
    """Its covariance, shape (3, 3)."""
    log_odds: float
    """Of this mode; the rest are other modes and submaps that have nothing in common."""
    evidence: float
    """Log of how much better its best motion explains the returns than submaps that have nothing in common."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The posterior of the relative pose of two submaps."""

    modes: tuple[Mode, ...]
    """Likeliest first; empty: they have nothing in common."""
    reach: FloatArray
    """Half sides of the box that was searched in the end, (x, y, theta), shape (3,)."""
    is_at_edge: bool
    """Whether the likeliest motion lies at the edge of that box: a maximum is none there."""

    @property
    def place(self) -> Mode | None:
        """The likeliest, if it is likelier than all else together and inside the box that was searched."""
        return self.modes[0] if self.modes and self.modes[0].log_odds > 0.0 and not self.is_at_edge else None


class PlaceView:
    """A submap as it is searched in: its returns, and tables of log ratios widened for every level of blocks.

    Many are kept: of the raster stay its points and its table in small integers.
    """

    def __init__(self, raster: Raster) -> None:
        self.points, self.weight, self._origin = raster.points, raster.weight, raster.origin
        self._whole = np.round(raster.table / _UNIT).astype(np.int8)
        self._tables: dict[int, tuple[np.ndarray, FloatArray]] = {}

    def bound(self, level: int, *, turned: bool = False) -> tuple[np.ndarray, FloatArray]:
        """The table, in `_UNIT`, widened to bound what a block of motions of this level finds in a cell.

        With `turned`, of a block whose axes are turned by any angle. Shape (H, W) int8, with a rim of zeros as wide as
        a block reaches back into the raster from beside it. And where its corner lies, m, shape (2,).
        """
        reach = 0 if level == 0 else int(np.ceil(0.71 * 2**level)) if turned else 2 ** (level - 1)
        if reach not in self._tables:
            table = _widened(np.pad(self._whole, reach + 1), reach)
            self._tables[reach] = table, self._origin - (reach + 1) * CELL_M
        return self._tables[reach]

    @cached_property
    def radius(self) -> float:
        """Distance beyond which a quarter of the points lie: what a small turn moves by a cell there, m."""
        return float(np.quantile(np.linalg.norm(self.points, axis=1), 0.75)) + CELL_M


def search_place(
    a: PlaceView, b: PlaceView, guess: FloatArray, covariance: FloatArray, reach: FloatArray, *, looks: float
) -> SearchResult:
    """All places where submap a may lie in submap b, about a guess with all its probable errors.

    The prior is a Student t about the guess, the likelihood that of all returns of each submap in the raster of the
    other, where what was not seen says nothing. Two questions are asked of it. *Which* of several places it is: there
    a whole wall is one witness, for buildings repeat walls, doors and corners, and returns of one wall agree or
    disagree together; so the log likelihood is divided by `looks`. *Where* in the place it is: there every look counts.
    A best motion at the edge of the box is no maximum: the box is made wider and searched again.

    Args:
        a, b: the submaps, each in its own frame.
        guess: (x, y, theta) of b_T_a, shape (3,).
        covariance: of its error, shape (3, 3).
        reach: half sides of the box searched at first, (x, y, theta), shape (3,).
        looks: looks that make one independent witness of the place, >= 1.

    References:
        Olson, "Real-time correlative scan matching", ICRA 2009; Hess et al., "Real-time loop closure in 2D LIDAR SLAM",
        ICRA 2016, for the bounds; Cummins and Newman, "FAB-MAP", IJRR 2008, for perceptual aliasing.
    """
    if not looks >= 1.0:
        raise ValueError(f"looks: expected at least 1, got {looks}")
    result = _search(a, b, guess, covariance, reach, looks)
    for _ in range(2):
        if result.is_at_edge:
            reach = np.minimum(2.0 * reach, (np.inf, np.inf, np.pi))
            result = _search(a, b, guess, covariance, reach, looks)
    return result


def _search(
    a: PlaceView, b: PlaceView, guess: FloatArray, covariance: FloatArray, reach: FloatArray, looks: float
) -> SearchResult:
    """The posterior within one box."""
    grid = np.array((0.5 * CELL_M, 0.5 * CELL_M, CELL_M / max(a.radius, b.radius)))  # half cells, and turns
    first = _first_level(reach, grid[2])
    information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
    steepest = float(np.sqrt(np.linalg.eigvalsh(information[:2, :2])[-1]))
    unit_mass = gamma(0.5 * _TAIL) * (_TAIL * np.pi) ** 1.5 / gamma(0.5 * (_TAIL + 3.0))
    mass = float(unit_mass * np.sqrt(np.linalg.det(covariance)))  # of all motions, by their density at the guess
    constant = np.log1p(-_NOTHING) - np.log(max(mass / (CELL_M**2 * grid[2]), 1.0))

    def prior(blocks: FloatArray) -> FloatArray:
        """Log of the prior, a Student t, at the middles of blocks, (M,)."""
        offsets = blocks * grid
        squared = np.einsum("ni,ij,nj->n", offsets, information, offsets)
        return constant + -0.5 * (_TAIL + 3.0) * np.log1p(squared / _TAIL)

    def scored(blocks: FloatArray, level: int) -> FloatArray:
        """Bound of the log of the posterior in blocks of a level, but for the prior's slope in them, (M,)."""
        return prior(blocks) + evidence_at(a, b, guess + blocks * grid, level) / looks

    blocks = _first_blocks(reach, grid[2], first)
    scores = scored(blocks, first)
    best = max(float(np.log(_NOTHING)), _beam_search(blocks, scores, first, scored))
    for level in range(first, -1, -1):
        if not level:
            best = max(best, float(scores.max(initial=best)))
        slack = _STEEPEST * np.sqrt(2.0) * 0.5 * (2**level - 1) * CELL_M * steepest
        kept = np.flatnonzero(scores + slack >= best - _NEGLIGIBLE)
        kept = kept[_largest(scores[kept], _MOST_BLOCKS)]
        blocks, scores = blocks[kept], scores[kept]
        if level:
            blocks = split(blocks, level)
            scores = scored(blocks, level - 1)
    if not len(blocks):
        return SearchResult((), reach, False)
    modes = _modes(guess, blocks, scores, scores - prior(blocks), grid, looks)
    near = np.array((4.0, 4.0, 2.0)) * grid  # two cells and two turns
    edge = bool(np.any(np.abs(blocks[np.argmax(scores)] * grid) > reach - near))
    return SearchResult(modes, reach, edge and expit(modes[0].log_odds) > _NOTHING)


def _beam_search(
    blocks: FloatArray, scores: FloatArray, level: int, scored: Callable[[FloatArray, int], FloatArray]
) -> float:
    """Score of the best motion found where of each level only the most promising blocks are split."""
    while level:
        blocks, level = split(blocks[_largest(scores, 100)], level), level - 1
        scores = scored(blocks, level)
    return float(scores.max())


def _first_level(reach: FloatArray, turn: float) -> int:
    """The level that the search begins at: higher where the box is so large that its blocks would be too many."""
    level = int(np.clip(np.ceil(np.log2(max(reach[:2].max(), CELL_M) / (2.0 * CELL_M))), 0, _TOP_LEVEL))
    headings = 2.0 * reach[2] / turn + 1.0
    while level < _HIGHEST_LEVEL and headings * np.prod(2.0 * reach[:2] / (2**level * CELL_M) + 1.0) > _MOST_BLOCKS:
        level += 1
    return level


@dataclass(frozen=True, eq=False)
class _Peak:
    """A set of neighbouring motions: which place by witnesses, where in it by looks."""

    cells: np.ndarray
    pose: FloatArray
    covariance: FloatArray
    log_mass: float
    evidence: float


def _modes(
    guess: FloatArray, blocks: FloatArray, scores: FloatArray, evidence: FloatArray, grid: FloatArray, looks: float
) -> tuple[Mode, ...]:
    """The places of a posterior, by the scores of its cells and their evidence, which are scores without the prior."""
    cells = np.round((blocks - blocks.min(axis=0)) * (0.5, 0.5, 1.0)).astype(np.int64)
    sizes = cells.max(axis=0) + 3
    strides = np.array((sizes[1] * sizes[2], sizes[2], 1))
    rank = np.argsort(cells @ strides)
    blocks, scores, evidence, keys = blocks[rank], scores[rank], evidence[rank], (cells @ strides)[rank]
    labels = peaks_of(keys, strides, np.argsort(-scores, kind="stable"), scores, _PROMINENCE)
    members = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    poses = guess + blocks * grid
    peaks = [_peak(member, poses[member], scores[member], evidence[member], grid, looks) for member in members]
    peaks.sort(key=lambda peak: -peak.log_mass)
    modes = []
    while peaks:
        place = [one for one in peaks if np.linalg.norm((one.pose - peaks[0].pose)[:2]) < _ONE_PLACE_M]
        peaks = [one for one in peaks if one not in place]
        modes.append(_mode(place, scores))
    return tuple(sorted(modes, key=lambda mode: -mode.log_odds))


def _peak(
    cells: np.ndarray, poses: FloatArray, scores: FloatArray, evidence: FloatArray, grid: FloatArray, looks: float
) -> _Peak:
    """Neighbouring cells as one Gaussian: what witnesses spread over, less by what looks know more.

    Where the evidence is a parabola that is what all looks leave. Along what they leave open it is level but for
    chance, and the chance of so many looks together would pick a cell.
    """
    weights = np.exp(evidence - _log_sum(evidence))
    mean = weights @ poses
    spread = np.einsum("n,ni,nj->ij", weights, poses - mean, poses - mean) / looks
    within = np.diag([*(2.0 * grid[:2]).tolist(), grid[2]]) ** 2 / 12.0
    return _Peak(cells, mean, spread + within, _log_sum(scores), float(looks * evidence[scores.argmax()]))


def _mode(place: list[_Peak], scores: FloatArray) -> Mode:
    """Peaks of one place together: a mixture."""
    masses = np.array([one.log_mass for one in place])
    shares = np.exp(masses - _log_sum(masses))
    mean = shares @ np.array([one.pose for one in place])
    spreads = [one.covariance + np.outer(one.pose - mean, one.pose - mean) for one in place]
    covariance = sum(share * spread for share, spread in zip(shares, spreads, strict=True))
    inside = np.zeros(len(scores), dtype=bool)
    inside[np.concatenate([one.cells for one in place])] = True
    log_odds = _log_sum(masses) - _log_sum(np.append(scores[~inside], np.log(_NOTHING)))
    return Mode(mean, np.asarray(covariance), log_odds, place[0].evidence)


def _widened(table: np.ndarray, reach: int) -> np.ndarray:
    """Largest value within `reach` cells in both directions, (H, W); outside the table lies the value 0, unknown."""
    for axis in (0, 1):
        table = maximum_filter1d(table, 2 * reach + 1, axis=axis, mode="constant", cval=0)
    return table


def evidence_at(a: PlaceView, b: PlaceView, motions: FloatArray, level: int = 0) -> FloatArray:
    """Log of how much better each motion (M, 3), b_T_a, explains the returns than having nothing in common, (M,).

    Of a level above 0 a bound of it in the block of motions about each.
    """
    order = np.argsort(motions[:, 2], kind="stable")
    headings, starts = np.unique(motions[order, 2], return_index=True)
    result = np.empty(len(motions))
    result[order] = score_by_heading(
        headings, np.append(starts, len(motions)), np.ascontiguousarray(motions[order, :2]), CELL_M,
        a.points, a.weight, *b.bound(level),
        b.points, b.weight, *a.bound(level, turned=True),
    )  # fmt: skip
    return _UNIT * result


def split(blocks: np.ndarray, level: int) -> np.ndarray:
    """The four blocks of the level below in each."""
    step = 2 ** (level - 1)  # half the side of a child in half cells
    corners = np.array([(i, j, 0) for i in (-step, step) for j in (-step, step)], dtype=np.float64)
    return (blocks[:, None, :] + corners).reshape(-1, 3)


def _log_sum(values: FloatArray) -> float:
    """Log of the sum of exponentials."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


def _largest(values: FloatArray, count: int) -> np.ndarray:
    """Indices of the largest values, in no order."""
    return np.arange(values.size) if values.size <= count else np.argpartition(-values, count)[:count]


def _first_blocks(reach: FloatArray, turn: float, level: int) -> FloatArray:
    """Middles of the blocks of a level that cover the box, as half cells and turns from the guess, shape (M, 3)."""
    side = 2 ** (level + 1)  # in half cells
    counts = np.ceil(2.0 * reach[:2] / (0.5 * CELL_M * side)).astype(int)
    x, y = (side * (np.arange(n) - 0.5 * (n - 1)) for n in counts)
    most = int(np.ceil(reach[2] / turn))
    grid = np.stack(np.meshgrid(x, y, np.arange(-most, most + 1), indexing="ij"), axis=-1)
    return grid.reshape(-1, 3).astype(np.float64)
