"""Scan-to-map matching: where a scan lies in the local map, with covariance, and whether it could lie elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from slam.frontend.information import inverted, positive
from slam.frontend.laser_odometry._match_kernels import align, score_box
from slam.frontend.laser_odometry.local_map import TABLE_CELL_M, LocalMap, Surface
from slam.frontend.occupancy._kernels import score_motions
from slam.frontend.occupancy.raster import CELL_M as RASTER_CELL_M
from slam.frontend.odometry import difference
from spplanes._check import FloatArray

#: The search reaches so many standard deviations.
_SIGMAS = 4.0
#: Places nearer than this are one, m and rad.
_SAME = np.array((0.1, 0.1, 0.05))


class Expected(NamedTuple):
    """One way in which the body may have moved, and what would then be expected."""

    pose: FloatArray
    """(x, y, theta) in the map, shape (3,)."""
    covariance: FloatArray
    """In the map's axes, shape (3, 3)."""
    probability: float
    """That it moved in this way."""


@dataclass(frozen=True, eq=False)
class Match:
    """Where a scan lies in the local map."""

    pose: FloatArray
    """(x, y, theta) in the map, the expected motion taken into account, shape (3,)."""
    information: FloatArray
    """What the returns alone say of the pose, in the map's axes, shape (3, 3)."""
    fit: float
    """Share of what was seen that the map has."""
    misfit: float
    """Half of the chi2 of what was seen beyond what it is expected to be."""
    way: int
    """In which of the ways the body moved."""
    odds: float = 1.0
    """Probability that it is not one of the other places looked at."""
    spread: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """Covariance over the places it could be, beyond that of each, shape (3, 3)."""


def match_scan(surface: Surface, there: LocalMap, ways: Sequence[Expected], usual_fit: float) -> Match:
    """The posterior of a scan's pose by a mixture of ways to move and the returns in the map.

    From what the first way expects it is found by Gauss-Newton on distances of points to lines. Where that is so badly
    known that this may end beside the truth, or less of the scan fits than usual, or the motion contradicts the first
    way, the boxes of all ways are searched; a best at the edge of its box, or nothing in it that fits as scans before
    did, makes it wider. Of several places the most probable one by all returns and all free space is taken, and how
    much the others leave open is said.

    Args:
        surface, there: the scan, the map.
        ways: the wheels, if any, and constant velocity, for wheels slip.
        usual_fit: share of the looks that fit, of scans before.

    References:
        Censi, "An ICP variant using a point-to-line metric", ICRA 2008; Olson, "Real-time correlative scan matching",
        ICRA 2009.
    """
    far = float(np.quantile(np.hypot(*surface.points.T), 0.75))
    found = [_aligned(surface, there, ways[0].pose, ways, 0)]
    if not _is_doubtful(found[0], surface, ways[0], usual_fit, far):
        return found[0]
    for way in range(len(ways)):
        found.append(_aligned(surface, there, found[0].pose, ways, way))
        found += _searched(surface, there, ways, way, usual_fit, far)
    return _most_probable(found, surface, there, ways)


def _is_doubtful(found: Match, surface: Surface, expected: Expected, usual_fit: float, far: float) -> bool:
    """Whether an alignment from the expected pose on may have ended beside the truth."""
    if _fits_worse(found, surface, usual_fit):
        return True
    sigmas, error = np.sqrt(np.diag(expected.covariance)), found.pose - expected.pose
    off_m = _SIGMAS * max(float(sigmas[:2].max()), float(sigmas[2]) * far)
    # an alignment begins with what is so far off; the second is 1e-3 for three degrees of freedom
    return off_m > 0.24 or float(error @ np.linalg.solve(expected.covariance, error)) > 16.3


def _fits_worse(found: Match, surface: Surface, usual_fit: float) -> bool:
    """Whether significantly less of a scan fits than of scans before it."""
    independent = max(float(surface.looks.sum()), 1.0)
    return usual_fit - found.fit > 3.0 * np.sqrt(usual_fit * (1.0 - usual_fit) / independent)


def _aligned(surface: Surface, there: LocalMap, start: FloatArray, ways: Sequence[Expected], way: int) -> Match:
    prior = ways[way].pose, inverted(ways[way].covariance)
    pose, told, erring, far, fit, misfit = align(start, surface, there.cells, *prior)
    # less what errs of it, not below none; a turn counts by its arc at `far`
    scale = np.outer((1.0, 1.0, far), (1.0, 1.0, far))
    return Match(pose, positive((told - erring) / scale) * scale, fit, misfit, way)


def _searched(
    surface: Surface, there: LocalMap, ways: Sequence[Expected], way: int, usual_fit: float, far: float
) -> list[Match]:
    """Alignments from all modes in the box of one way, at first at most 1 m and 0.6 rad to either side.

    The box is doubled, three times at most, where the best of it lies at its edge; as far as the way reaches also where
    nothing in it fits as usual.
    """
    sigmas = np.sqrt(np.diag(ways[way].covariance))
    full = _SIGMAS * sigmas[:2].max(), _SIGMAS * sigmas[2]
    reach = [min(max(one, least), most) for one, least, most in zip(full, (0.2, 0.1), (1.0, 0.6), strict=True)]
    found: list[Match] = []
    for widening in range(4):
        coarser = 2.0 if widening else 1.0  # of cells and turns: an alignment finds what lies within them
        modes, shifted, turned = _modes(surface, there, ways[way].pose, reach, far, coarser)
        found += [_aligned(surface, there, mode, ways, way) for mode in modes]
        unlike = all(_fits_worse(one, surface, usual_fit) for one in found)
        wider = [
            min(r * (1 + (at_edge or (unlike and r < whole))), largest)
            for r, whole, at_edge, largest in zip(reach, full, (shifted, turned), (4.0, np.pi), strict=True)
        ]
        if wider == reach:
            break
        reach = wider
    return found


def _modes(
    surface: Surface, there: LocalMap, centre: FloatArray, reach: Sequence[float], far: float, coarser: float
) -> tuple[list[FloatArray], bool, bool]:
    """Up to five poses in a box, so many m and rad to either side, about which the scan lies near the map's surfaces,
    best first, none much worse than it; and whether the best is at the edge of the box, in place and in heading. Steps
    are so many times coarser."""
    (table, origin), cell = there.table(coarser), coarser * TABLE_CELL_M
    every = max(1, len(surface.points) // 90)  # so many returns are enough
    points, looks = np.ascontiguousarray(surface.points[::every]), np.ascontiguousarray(surface.looks[::every])
    step = cell / max(far, 1.0)
    steps, turns = int(np.ceil(reach[0] / cell)), int(np.ceil(reach[1] / step))
    angles = step * np.arange(-turns, turns + 1)
    scores = score_box(points, looks, centre, table, origin, cell, angles, steps)
    t, r, k = np.unravel_index(int(scores.argmax()), scores.shape)
    peaks = (scores == maximum_filter(scores, size=5)) & (scores > 0.75 * scores.max())
    places = np.argwhere(peaks)
    places = places[np.argsort(-scores[tuple(places.T)], kind="stable")][:5]
    shifts = [((k - steps) * cell, (r - steps) * cell, angles[t]) for t, r, k in places.tolist()]
    meets = bool(scores.max() > 0.0)
    at_edge = meets and bool({int(r), int(k)} & {0, 2 * steps}), meets and t in (0, 2 * turns)
    return [centre + np.array(shift) for shift in shifts], *at_edge


def _most_probable(found: list[Match], surface: Surface, there: LocalMap, ways: Sequence[Expected]) -> Match:
    """The most probable of several alignments, with what the others leave open."""
    poses = np.array([one.pose for one in found])
    # of one place found in two ways the way counts too: where the wheels agree with the returns, they did not slip
    costs = np.array([_unlikelihood(one.pose, ways[one.way]) + one.misfit for one in found])
    # the cells of the rasters are too coarse to tell what is nearer than a cell: the misfit does
    if any((np.abs(difference(pose, poses[0])) > _SAME).any() for pose in poses):
        costs -= score_motions(poses, RASTER_CELL_M, LocalMap(((surface, np.zeros(3)),)).raster, there.raster)
    order = np.argsort(costs, kind="stable").tolist()
    best, rivals = order[0], []
    for k in order[1:]:  # alignments that ended in one place are one
        if all((np.abs(difference(poses[k], poses[j])) > _SAME).any() for j in (best, *rivals)):
            rivals.append(k)
    weights = np.exp(costs[best] - costs[rivals])
    total = 1.0 + float(weights.sum())
    apart = np.array([difference(poses[k], poses[best]) for k in rivals]).reshape(-1, 3)
    spread = np.einsum("n,ni,nj->ij", weights / total, apart, apart)
    return replace(found[best], odds=1.0 / total, spread=spread)


def _unlikelihood(pose: FloatArray, way: Expected) -> float:
    """Minus the log of the density of a pose and of having come there in this way."""
    error = difference(pose, way.pose)
    covariance = way.covariance.copy()
    if covariance[2, 2] > 2.0 * np.pi:  # headings lie on a circle: at its peak no density is below the uniform one
        scale = np.array((1.0, 1.0, np.sqrt(2.0 * np.pi / covariance[2, 2])))
        covariance *= np.outer(scale, scale)
    chi2 = float(error @ np.linalg.solve(covariance, error))
    return 0.5 * (np.linalg.slogdet(covariance)[1] + chi2) - np.log(way.probability)
