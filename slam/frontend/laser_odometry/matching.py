"""Scan-to-map matching: where a scan lies in the local map, with covariance, and whether it could lie elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from slam.frontend.laser_odometry._match_kernels import align, score_box
from slam.frontend.laser_odometry.local_map import CELL_M, TABLE_CELL_M, LocalMap, Surface
from spplanes._check import FloatArray

#: Degrees of freedom of the odometry's Student t distribution: wheels slip.
TAIL = 4.0
#: Rounds of Gauss-Newton.
_ROUNDS = 15
#: Returns off by less than this are found without a search, m.
_BASIN_M = 0.12
#: The search reaches so many standard deviations; where the best lies at its edge it is doubled, so many times.
_SIGMAS, _WIDENINGS = 4.0, 3
#: The most that is searched at first and at all, m and rad.
_LEAST_BOX, _LARGEST_BOX = (0.3, 0.45), (3.0, np.pi)
#: Modes of the search that are looked at, if they are this share as near as the best.
_MODES, _RIVAL = 5, 0.75
#: A scan fits worse than scans before it where its share lies so many standard deviations below theirs.
_SIGNIFICANT = 3.0
#: Returns that the search uses.
_SEARCHED = 90


@dataclass(frozen=True, eq=False)
class Match:
    """Where a scan lies in the local map."""

    pose: FloatArray
    """(x, y, theta) in the map, odometry taken into account, shape (3,)."""
    information: FloatArray
    """What the returns alone say of the pose, in the map's axes, shape (3, 3)."""
    fit: float
    """Share of what was seen that the map has."""
    odds: float
    """Probability that it is not one of the other places looked at."""
    spread: FloatArray
    """Covariance over the places it could be, beyond that of each, shape (3, 3)."""


def match_scan(
    surface: Surface, there: LocalMap, expected: FloatArray, covariance: FloatArray, usual_fit: float
) -> Match:
    """The posterior of a scan's pose by a Student t about the expected one and the returns in the map.

    From the expected pose on it is found by Gauss-Newton on distances of points to lines. Where the expected pose is so
    badly known that this may end beside the truth, or less of the scan fits than usual, the whole box of probable poses
    is searched first; a best at the box's edge makes it wider.

    Args:
        surface: the scan.
        there: the map.
        expected: pose by odometry, (x, y, theta), shape (3,), with `covariance` (3, 3).
        usual_fit: share of the looks that fit, of scans before.

    References:
        Censi, "An ICP variant using a point-to-line metric", ICRA 2008; Olson, "Real-time correlative scan matching",
        ICRA 2009.
    """
    information = np.linalg.inv(covariance)
    far = float(np.quantile(np.hypot(*surface.points.T), 0.75))
    sigmas = np.sqrt(np.diag(covariance))
    found = [_aligned(surface, there, expected, expected, information)]
    independent = max(float(surface.looks.sum()), 1.0)
    doubtful = usual_fit - found[0][3] > _SIGNIFICANT * np.sqrt(usual_fit * (1.0 - usual_fit) / independent)
    if doubtful or _SIGMAS * max(float(sigmas[:2].max()), float(sigmas[2]) * far) > 2.0 * _BASIN_M:
        for start in _modes(surface, there, expected, sigmas, far):
            found.append(_aligned(surface, there, start, expected, information))
    return _weighed(found, information)


def _aligned(surface: Surface, there: LocalMap, start: FloatArray, expected: FloatArray, information: FloatArray):
    return align(
        start, surface.points, surface.normals, surface.variance, surface.looks,
        there.points, there.normals, there.weights, there.start, there.origin, CELL_M, there.columns, there.rows,
        expected, information, TAIL, _ROUNDS, 2.0 * _BASIN_M,
    )  # fmt: skip


def _modes(surface: Surface, there: LocalMap, expected: FloatArray, sigmas: FloatArray, far: float) -> list[FloatArray]:
    """Poses about which the scan lies near the map's surfaces, best first."""
    table, origin = there.table
    every = max(1, len(surface) // _SEARCHED)
    points, looks = surface.points[::every], surface.looks[::every]
    step = TABLE_CELL_M / max(far, 1.0)
    reach_m, reach_rad = (max(_SIGMAS * s, least) for s, least in zip((sigmas[:2].max(), sigmas[2]), _LEAST_BOX))
    for _ in range(_WIDENINGS):
        reach_m, reach_rad = min(reach_m, _LARGEST_BOX[0]), min(reach_rad, _LARGEST_BOX[1])
        steps, turns = int(np.ceil(reach_m / TABLE_CELL_M)), int(np.ceil(reach_rad / step))
        angles = step * np.arange(-turns, turns + 1)
        scores = score_box(points, looks, expected, table, origin, TABLE_CELL_M, angles, steps)
        best = np.unravel_index(int(scores.argmax()), scores.shape)
        at_edge = min(best[0], 2 * turns - best[0]) == 0, min(min(k, 2 * steps - k) for k in best[1:]) == 0
        if not any(at_edge) or (reach_m, reach_rad) == _LARGEST_BOX:
            break
        reach_m, reach_rad = reach_m * (1 + at_edge[1]), reach_rad * (1 + at_edge[0])
    peaks = (scores == maximum_filter(scores, size=5)) & (scores > _RIVAL * scores.max())
    places = np.argwhere(peaks)
    places = places[np.argsort(-scores[tuple(places.T)], kind="stable")][:_MODES]
    return [
        expected + np.array(((k - steps) * TABLE_CELL_M, (r - steps) * TABLE_CELL_M, angles[t]))
        for t, r, k in places.tolist()
    ]


def _weighed(found: list[tuple[FloatArray, FloatArray, float, float]], prior: FloatArray) -> Match:
    """The best of several alignments, with what the others leave open."""
    costs = np.array([one[2] for one in found])
    best = int(costs.argmin())
    pose, information, _, fit = found[best]
    covariance = np.linalg.inv(information + 0.1 * prior)
    apart = np.array([one[0] for one in found]) - pose
    apart[:, 2] = np.remainder(apart[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    other = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(covariance + _SAME), apart) > 9.0
    weights = np.where(other, np.exp(costs[best] - costs), 0.0)
    kept: list[int] = []
    for k in np.argsort(costs, kind="stable").tolist():  # alignments that ended in one place are one
        if other[k] and all(np.abs(found[k][0] - found[j][0])[:2].max() > _BASIN_M for j in kept):
            kept.append(k)
    total = 1.0 + float(weights[kept].sum())
    spread = np.einsum("n,ni,nj->ij", weights[kept] / total, apart[kept], apart[kept])
    return Match(pose, information, fit, 1.0 / total, spread)


#: Places nearer than this are one, m and rad, as variances.
_SAME = np.diag((0.03**2, 0.03**2, 0.01**2))
