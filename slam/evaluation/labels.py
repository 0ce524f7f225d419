"""Segmentations against true labels: purity, planes found, over-segmentation, and Hoover's counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slam.evaluation.metrics import Metric

#: A true plane counts when it has more points than this ...
ENOUGH_POINTS = 200
#: ... and is found when the regions that are mostly it cover this share of its points.
FOUND_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class LabelTable:
    """How many points each region shares with each true plane."""

    counts: np.ndarray
    """Common points, shape (R, P): regions by true planes, without the points of none."""
    region_sizes: np.ndarray
    """Points of each region, those of no true plane included, shape (R,)."""
    plane_sizes: np.ndarray
    """Points of each true plane, those in no region included, shape (P,)."""
    n_points: int
    """All points there are: labelled, of a true plane, or both."""

    @classmethod
    def of(cls, labels: ArrayLike, truth: ArrayLike, valid: ArrayLike | None = None) -> LabelTable:
        """Count labels (any shape) against true labels (the same shape); negative means none.

        `valid` masks the points there are (returns); by default those that have a label or a true plane.

        Raises:
            ValueError: the shapes differ.
        """
        found, true = np.asarray(labels), np.asarray(truth)
        if found.shape != true.shape:
            raise ValueError(f"labels: expected the shape {true.shape} of the truth, got {found.shape}")
        mask = (found >= 0) | (true >= 0) if valid is None else np.asarray(valid, dtype=bool)
        found, true = found[mask], true[mask]
        n_regions, n_planes = (int(x.max(initial=-1)) + 1 for x in (found, true))
        table = np.zeros((n_regions + 1, n_planes + 1), dtype=np.int64)  # the last row and column are "none"
        np.add.at(table, (np.where(found < 0, n_regions, found), np.where(true < 0, n_planes, true)), 1)
        return cls(table[:-1, :-1], table[:-1].sum(axis=1), table[:, :-1].sum(axis=0), int(mask.sum()))


def label_metrics(table: LabelTable, *, more_than: int = ENOUGH_POINTS) -> list[Metric]:
    """The measures of a map: represented, purity, planes found, over-segmentation.

    Purity is the share of labelled points that belong to the true plane most of their region belongs to; a point of no
    plane is impure. Over-segmentation is the share of regions, of those that are mostly a true plane of more than so
    many points, which are one too many.
    """
    regions = np.flatnonzero(table.region_sizes)
    wanted = np.flatnonzero(table.plane_sizes > more_than)
    majority = table.counts.argmax(axis=1) if table.counts.shape[1] else np.zeros(len(table.counts), dtype=np.int64)
    pure = int(table.counts.max(axis=1, initial=0).sum())
    labelled = int(table.region_sizes.sum())
    belongs = [regions[(majority[regions] == plane) & (table.counts[regions, plane] > 0)] for plane in wanted]
    found = [
        table.counts[mine, plane].sum() >= FOUND_SHARE * table.plane_sizes[plane]
        for plane, mine in zip(wanted, belongs, strict=True)
    ]
    extra = sum(max(len(mine) - 1, 0) for mine in belongs)
    return [
        Metric("points", table.n_points, ""),
        Metric("regions", len(regions), ""),
        Metric("points represented", _percent(labelled, table.n_points), "%"),
        Metric("label purity", _percent(pure, labelled), "%"),
        Metric(f"true planes above {more_than} points", len(wanted), ""),
        Metric("true planes found", _percent(int(np.sum(found)), len(wanted)), "%"),
        Metric("over-segmentation", _percent(extra, sum(map(len, belongs))), "%"),
    ]


@dataclass(frozen=True)
class HooverCounts:
    """Instances by Hoover's five classes."""

    correct: int
    """Pairs of a region and a true plane that are each other at the overlap asked for."""
    over_segmented: int
    """True planes covered by several regions that lie in them."""
    under_segmented: int
    """Regions that cover several true planes."""
    missed: int
    """True planes in none of these."""
    noise: int
    """Regions in none of these."""
    n_true: int
    """True planes there are."""


def hoover_counts(table: LabelTable, *, overlap: float = 0.8) -> HooverCounts:
    """Compare regions with true planes at an overlap above one half.

    References:
        Hoover et al., "An experimental comparison of range image segmentation algorithms", PAMI 18(7), 1996.
    """
    regions, planes = np.flatnonzero(table.region_sizes), np.flatnonzero(table.plane_sizes)
    common = table.counts[np.ix_(regions, planes)]
    in_plane = common >= overlap * table.region_sizes[regions][:, None]  # the region lies in the plane
    in_region = common >= overlap * table.plane_sizes[planes][None, :]  # the plane lies in the region
    correct = in_plane & in_region
    free_regions, free_planes = np.logical_not(correct.any(axis=1)), np.logical_not(correct.any(axis=0))

    open_pairs = np.outer(free_regions, free_planes)
    parts = in_plane & open_pairs
    covered = (common * parts).sum(axis=0) >= overlap * table.plane_sizes[planes]
    over = covered & (parts.sum(axis=0) >= 2)
    wholes = in_region & open_pairs
    filled = (common * wholes).sum(axis=1) >= overlap * table.region_sizes[regions]
    under = filled & (wholes.sum(axis=1) >= 2)

    explained_planes = correct.any(axis=0) | over | wholes[under].any(axis=0)
    explained_regions = correct.any(axis=1) | under | parts[:, over].any(axis=1)
    return HooverCounts(
        correct=int(correct.any(axis=0).sum()),
        over_segmented=int(over.sum()),
        under_segmented=int(under.sum()),
        missed=int(np.sum(~explained_planes)),
        noise=int(np.sum(~explained_regions)),
        n_true=len(planes),
    )


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else float("nan")
