"""Splitting: a plane of a push-broom window that is two, a wall and the board on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spplanes import MapperConfig, Plane
from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes.registration import RegisteredScans
from spplanes.segmentation.config import ValidationConfig
from spplanes.segmentation.planes import planes_of
from spplanes.segmentation.sheet import means_of
from spplanes.segmentation.validation.plane_ends import Window

#: Largest chi2 (1 dof) of a step between two parts of one plane, the largest of some hundred cuts.
LIMIT = 18.0
#: Fewest points on either side of a cut.
FEWEST = 6

Cut = Callable[[np.ndarray], tuple[np.ndarray, float]]


def purified(
    placed: RegisteredScans,
    labels: np.ndarray,
    planes: list[Plane],
    pose_covariances: FloatArray,
    uneven_m: float,
    mapper: MapperConfig,
    rules: ValidationConfig,
) -> tuple[np.ndarray, list[Plane]]:
    """Labels (S, B) and planes of a window, each of one plane; the same where each is one already. `pose_covariances`
    are the joint ones of the scans' poses, (6 S, 6 S), in the order of the SPmodel, `uneven_m` the standard deviation
    of surfaces from planes. Steps are twice what `rules` let patches lie off their plane, or more."""
    window = Window(placed.points, placed.covariances, pose_covariances)
    frames = [plane.frame for plane in planes]
    fresh = pure_labels(window, labels, frames, uneven_m, 2.0 * rules.step_m, mapper.for_rows(len(labels)))
    if fresh is labels:
        return labels, planes
    noise = np.ascontiguousarray(placed.covariances).reshape(*labels.shape, 9)
    return fresh, planes_of(placed.points, noise, fresh, placed.viewpoints, None, mapper)


def pure_labels(
    window: Window,
    labels: np.ndarray,
    frames: Sequence[FloatArray],
    uneven_m: float,
    step_m: float,
    mapper: MapperConfig,
) -> np.ndarray:
    """Labels (S, B) of the planes that those of `labels` really are; the very same array where nothing changes. For
    `uneven_m` and `step_m` see `parts_of`; what is parted and is less than `mapper` says of a plane is none."""
    fresh, count, parted = np.full_like(labels, -1), 0, False
    for r, frame in enumerate(frames):
        members = np.flatnonzero(labels == r)
        parts = parts_of(window, members, frame, uneven_m, step_m) if len(members) else []
        parted |= len(parts) > 1
        for part in parts:
            large = len(part) >= mapper.min_points
            if len(parts) == 1 or (large and tells_tilt(window, part, frame, mapper.max_tilt_rad)):
                fresh.ravel()[part] = count
                count += 1
    return fresh if parted else labels


def tells_tilt(window: Window, part: np.ndarray, frame: FloatArray, max_tilt_rad: float) -> bool:
    """Whether points, flat indices (N,), are spread enough along a plane to tell its tilt."""
    if len(part) < 3:
        return False
    points, covariances = window.points.reshape(-1, 3)[part], window.covariances.reshape(-1, 3, 3)[part]
    place, _, weights = along_plane(points, covariances, frame)
    return are_spread(place, weights, max_tilt_rad)


def are_spread(places: FloatArray, weights: FloatArray, max_tilt_rad: float) -> bool:
    """Whether places (N, 2) on a plane, with weights (N,) of their residuals, tell its tilt to so much."""
    aside = places - weights @ places / weights.sum()
    return float(np.linalg.eigvalsh((aside * weights[:, None]).T @ aside)[0]) * max_tilt_rad**2 >= 1.0


def parts_of(
    window: Window, members: np.ndarray, frame: FloatArray, uneven_m: float, step_m: float
) -> list[np.ndarray]:
    """Points of each of the planes that what was taken for one consists of, largest first; one as a rule.

    A step of a few centimetres hides in the noise of the points, most of all when the plane tilts to meet both sides;
    not in that of all points beyond it. The points are parted where a step explains the residuals best, until no step
    is left, and parts between which there is none become one again. Members are ascending flat indices of the window,
    (N,), the frame is of the plane that was fitted to them; surfaces deviate by `uneven_m` from planes (one sigma),
    smaller steps than `step_m` are none.
    """
    cut = _cutter(window, members, frame, uneven_m, step_m)
    parts, unsure = [], [np.arange(len(members))]
    while unsure:
        part = unsure.pop()
        beyond, chi2 = cut(part)
        if chi2 <= LIMIT:
            parts.append(part)
        else:
            unsure += [part[beyond], part[~beyond]]
    parts.sort(key=lambda part: (-len(part), part[0]))
    return [members[part] for part in _rejoined(parts, cut)]


def _cutter(window: Window, members: np.ndarray, frame: FloatArray, uneven_m: float, step_m: float) -> Cut:
    """What cuts a subset of the members best: which of the subset are beyond, and the chi2 (1 dof) of the step.
    Residuals are explained by a plane, by an offset of every scan, and by a step between the two sets. Sets are parted
    between two scans, between two beams, or have a corner of the grid to themselves."""
    scan, beam = np.divmod(members, window.points.shape[1])
    points, covariances = window.points.reshape(-1, 3)[members], window.covariances.reshape(-1, 3, 3)[members]
    place, residuals, weights = along_plane(points, covariances, frame)
    drift = drift_of_scans(points, frame[:3, 2], scan, window.pose_covariances)
    rule = float(uneven_m**2), float(step_m)

    def cut(part: np.ndarray) -> tuple[np.ndarray, float]:
        if len(part) < 2 * FEWEST:
            return np.zeros(len(part), dtype=bool), 0.0
        scans, row = np.unique(scan[part], return_inverse=True)
        column, w = beam[part] - beam[part].min(), weights[part]
        inverse, left = _explained(row, place[part], residuals[part], w, np.linalg.inv(drift[np.ix_(scans, scans)]))
        sums = np.zeros((len(scans), column.max() + 2, 5))  # over the beams before
        each = np.column_stack((w, w[:, None] * place[part], w * left, np.ones(len(part))))
        np.add.at(sums, (row, column + 1), each)
        (i0, i1, j0, j1), chi2 = _surest(np.cumsum(sums, axis=1), inverse, rule)
        return (row >= i0) & (row < i1) & (column >= j0) & (column < j1), chi2

    return cut


def _rejoined(parts: list[np.ndarray], cut: Cut) -> list[np.ndarray]:
    """Parts between which there is no step, as one; a board parts the wall that goes on beyond it."""
    if len(parts) < 3:
        return parts
    whole: list[np.ndarray] = []
    for part in parts:
        for k, other in enumerate(whole):
            both = np.sort(np.concatenate((other, part)))
            if cut(both)[1] <= LIMIT:
                whole[k] = both
                break
        else:
            whole.append(part)
    return whole


@njit(cache=True)
def _surest(sums, inverse, rule):
    """Scans and beams, from and to, of the surest step that is left, and its chi2; see `_cutter`. Corners are sought
    between 24 bands of beams, and must be surer by 7.4: there are forty times as many of them as of straight cuts, and
    2 log 40 is that. `sums` over the beams before, (S, B + 1, 5): weights, these by places and residuals, points;
    `rule`: variance of a step on one plane, for surfaces are not flat, m^2; the least, m."""
    n_rows, n_columns = sums.shape[0], sums.shape[1] - 1
    best, cut = 0.0, (0, n_rows, 0, 0)
    every = max(n_columns // 24, 1)
    z = np.empty(3 + n_rows)
    for a in range(n_rows):
        for b in range(1, n_columns + 1):
            straight = a == 0 or b == n_columns
            if not straight and b % every != 0:
                continue
            for corner in range(1 if straight else 4):
                i0, i1 = (a, n_rows) if corner % 2 == 0 else (0, a)
                j0, j1 = (0, b) if corner < 2 else (b, n_columns)
                chi2 = _step(sums, (i0, i1, j0, j1), inverse, rule, z) - (0.0 if straight else 7.4)
                if chi2 > best:
                    best, cut = chi2, (i0, i1, j0, j1)
    return cut, best


def _explained(row, place, residuals, weights, drift):
    """Covariance of plane and offsets of scans, (3 + S, 3 + S), and what they leave of the residuals, shape (N,)."""
    shape = np.column_stack((np.ones(len(row)), place))
    weighted = weights[:, None] * shape
    of_scans = np.array([np.bincount(row, column, len(drift)) for column in weighted.T])
    matrix = np.block([[weighted.T @ shape, of_scans], [of_scans.T, drift + np.diag(of_scans[0])]])
    matrix[np.diag_indices_from(matrix)] *= 1.0 + 1e-9  # points of one line do not tell a tilt
    inverse = np.linalg.inv(matrix)
    right = np.concatenate((weighted.T @ residuals, np.bincount(row, weights * residuals, len(drift))))
    found = inverse @ right
    return inverse, residuals - shape @ found[:3] - found[3 + row]


@inlined
def _step(sums, box, inverse, rule, z):
    """Chi2 of the step of the points in scans i0 to i1 and beams j0 to j1, from sums over beams before."""
    (i0, i1, j0, j1), (uneven, least) = box, rule
    z[:] = 0.0
    moment, count = 0.0, 0.0
    for i in range(i0, i1):
        for k in range(3):
            z[k] += sums[i, j1, k] - sums[i, j0, k]
        z[3 + i] = sums[i, j1, 0] - sums[i, j0, 0]
        moment += sums[i, j1, 3] - sums[i, j0, 3]
        count += sums[i, j1, 4] - sums[i, j0, 4]
    if count < FEWEST or sums[:, -1, 4].sum() - count < FEWEST:
        return 0.0
    share = z[0]
    for a in range(z.shape[0]):
        if z[a] != 0.0:
            explained = 0.0
            for b in range(z.shape[0]):
                explained += inverse[a, b] * z[b]
            share -= z[a] * explained
    if share <= 1e-6 * z[0]:
        return 0.0
    step = moment / share
    return step * step / (1.0 / share + uneven) if abs(step) >= least else 0.0


def drift_of_scans(
    points: FloatArray, normal: FloatArray, scan: np.ndarray, pose_covariances: FloatArray
) -> FloatArray:
    """Covariance (S, S) of what the errors of the poses, (6 S, 6 S), shift the scans by along a plane's normal, m^2.
    Points (N, 3) of one scan, `scan` (N,), are taken at their middle. A tenth of a millimetre is granted in any
    case."""
    n_scans = len(pose_covariances) // 6
    middles = means_of(points, scan, n_scans)
    levers = [np.cross(axis, middles) @ normal for axis in np.eye(3)[::-1]]
    jacobian = np.column_stack([np.tile(normal, (n_scans, 1)), *levers])
    joint = np.asarray(pose_covariances).reshape(n_scans, 6, n_scans, 6)
    return np.einsum("ia,iajb,jb->ij", jacobian, joint, jacobian) + 1e-8 * np.eye(n_scans)


def along_plane(
    points: FloatArray, covariances: FloatArray, frame: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places (N, 2) on the plane, distances (N,) from it and their weights. Places are where the points most likely are
    on the plane: their errors do not go with those of the distances."""
    residuals = (points - frame[:3, 3]) @ frame[:3, 2]
    toward = covariances @ frame[:3, 2]
    variances = np.maximum(toward @ frame[:3, 2], 1e-12)
    on_plane = points - toward * (residuals / variances)[:, None]
    return (on_plane - frame[:3, 3]) @ frame[:3, :2], residuals, 1.0 / variances
