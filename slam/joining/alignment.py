"""Alignment of two maps: the motion between them by all common planes, with the joint covariance of each map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from factors._conventions import hesse_to_sp
from factors.association.decisions import AssociationGates
from slam.geometry.frames import inverse
from slam.geometry.polygons import flatten
from slam.joining.mission import Mission
from slam.map.map_planes import MapPlane
from slam.mapping.same_plane import disjoint
from spplanes._check import FloatArray
from spplanes._hesse import hesse_jacobian
from spplanes.spmodel import skew

#: Standard deviations of what walls alone leave open between two missions on one floor: z, m, and roll and pitch, rad.
#: Wide beside any floor, and narrow enough that the sum of squares can be solved.
LEVEL_SIGMA_M, LEVEL_SIGMA_RAD = 0.5, 0.05
_STEPS = 10
#: A step this small, in standard deviations of the motion, is none.
_SETTLED = 1e-3
#: Directions in which the planes say less than this share of the best known one are left open.
_OPEN = 1e-6


@dataclass(frozen=True, eq=False)
class Alignment:
    """Two maps laid on each other."""

    a_T_b: FloatArray
    """Takes b's coordinates to a's, shape (4, 4)."""
    covariance: FloatArray
    """Of its tangent on the right, GTSAM order (rotation, translation), shape (6, 6)."""
    pairs: tuple[tuple[int, int], ...]
    """Places in the lists of planes of a and b that are one."""
    chi2: float
    """Of all pairs at this motion, with what the planes of each map share."""
    n_dof: int
    worst: int = -1
    """The pair that fits the others least."""

    def fits(self, significance: float) -> bool:
        """Whether the pairs agree; of those that are true all a share of `significance` does not."""
        return self.n_dof > 0 and self.chi2 <= float(chdtri(self.n_dof, significance))


def common_planes(
    a: Mission, b: Mission, a_T_b: FloatArray, covariance: FloatArray, config: AssociationGates
) -> list[tuple[int, int]]:
    """Planes of two maps that may be one under an uncertain motion: best first, none twice.

    They look the same way, what was seen of them comes within `config.gap_m`, and their chi2 (3 dof) with the motion's
    and both planes' covariances passes.
    """
    limit = float(chdtri(3, config.significance))
    found = []
    for i, j, _ in facing_pairs(a, b, a_T_b, config):
        off, by_b, by_motion = _difference(a.planes[i], b.planes[j], a_T_b)
        spread = a.planes[i].plane.covariance + by_b @ b.planes[j].plane.covariance @ by_b.T
        spread = spread + by_motion @ covariance @ by_motion.T
        chi2 = float(off @ np.linalg.solve(spread, off))
        if chi2 <= limit:
            # the most surprising agreement first: a wide pair agrees with everything
            found.append((chi2 + float(np.linalg.slogdet(spread)[1]), i, len(a.planes) + j))
    return [(i, j - len(a.planes)) for i, j in disjoint([(i, j) for _, i, j in sorted(found)])]


def facing_pairs(a: Mission, b: Mission, a_T_b: FloatArray, config: AssociationGates) -> list[tuple[int, int, float]]:
    """Planes of two maps that look the same way under a motion, and how far over each other they lie, m.

    What was seen of them comes near, along the planes and across.
    """
    if not a.planes or not b.planes:
        return []
    normals = np.array([plane.plane.normal for plane in b.planes]) @ a_T_b[:3, :3].T
    alike = np.array([plane.plane.normal for plane in a.planes]) @ normals.T > np.cos(config.max_angle_rad)
    found = []
    for i, j in np.argwhere(alike).tolist():
        first_T_second = inverse(a.planes[i].plane.frame) @ a_T_b @ b.planes[j].plane.frame
        apart = abs(float(first_T_second[2, 3]))
        if (
            apart <= config.gap_m
            and flatten(b.planes[j].seen, first_T_second).distance(a.planes[i].seen) <= config.gap_m
        ):
            found.append((i, j, apart))
    return found


def align(a: Mission, b: Mission, pairs: Sequence[tuple[int, int]], a_T_b: FloatArray) -> Alignment:
    """Generalised least squares over pairs of planes: the motion, and how well they agree under it.

    What a pair is off is the SP perturbation from a's plane to b's, in a's plane frame; of all pairs together it has
    the covariance that both maps' joint covariances give. What walls alone leave open is held to the start, up to
    `LEVEL_SIGMA_M` and `LEVEL_SIGMA_RAD`.

    Args:
        a, b: the maps.
        pairs: which of their planes are one; at least one.
        a_T_b: about the motion, shape (4, 4).
    """
    start, level = a_T_b, _level_information(a_T_b)
    residual, whitened = whitened_differences(a, b, pairs, a_T_b)
    for _ in range(_STEPS):
        information = whitened.T @ whitened + level
        moved = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(start) @ a_T_b))
        step = -np.linalg.solve(information, whitened.T @ residual + level @ moved)
        a_T_b = a_T_b @ gtsam.Pose3.Expmap(step).matrix()
        residual, whitened = whitened_differences(a, b, pairs, a_T_b)
        if step @ information @ step < _SETTLED**2:
            break
    information = whitened.T @ whitened + level
    scales = np.linalg.svd(whitened @ np.diag(1.0 / np.sqrt(np.diag(information))), compute_uv=False)
    fixed = int((scales > _OPEN * max(float(scales[0]), 1e-300)).sum())
    shares = (residual.reshape(-1, 3) ** 2).sum(axis=1)
    return Alignment(
        a_T_b,
        np.linalg.inv(information).astype(np.float64),
        tuple(pairs),
        float(residual @ residual),
        3 * len(pairs) - fixed,
        int(np.argmax(shares)),
    )


def whitened_differences(
    a: Mission, b: Mission, pairs: Sequence[tuple[int, int]], a_T_b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What pairs are off (3 K,) and the derivative by the motion (3 K, 6), in units of their joint covariance."""
    rows_a, rows_b = (np.array(side) for side in zip(*pairs, strict=True))
    parts = [_difference(a.planes[i], b.planes[j], a_T_b) for i, j in pairs]
    by_b = np.asarray(block_diag(*(part[1] for part in parts)), dtype=np.float64)
    spread = a.covariance_of(rows_a) + by_b @ b.covariance_of(rows_b) @ by_b.T
    root = np.linalg.cholesky(spread)
    off, by_motion = np.concatenate([part[0] for part in parts]), np.vstack([part[2] for part in parts])
    told = np.asarray(np.linalg.solve(root, np.column_stack((off, by_motion))), dtype=np.float64)
    return told[:, 0], told[:, 1:]


def _level_information(a_T_b: FloatArray) -> FloatArray:
    """Of the motion's tangent, with z, roll and pitch of b in a held and nothing else, shape (6, 6)."""
    turn = a_T_b[:3, :3]
    of_turn, of_shift = np.diag([LEVEL_SIGMA_RAD**-2, LEVEL_SIGMA_RAD**-2, 0.0]), np.diag([0.0, 0.0, LEVEL_SIGMA_M**-2])
    return np.asarray(block_diag(turn.T @ of_turn @ turn, turn.T @ of_shift @ turn))


def _difference(first: MapPlane, second: MapPlane, a_T_b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How a plane of b differs from one of a under a motion.

    Returns:
        (z, theta, psi) from a's plane to b's in a's plane frame, its derivative by b's own perturbation (3, 3) and by
        the motion's tangent (3, 6). Both frames' errors enter: by a's own it is minus one.
    """
    rotation, shift = a_T_b[:3, :3], a_T_b[:3, 3]
    to_sp = hesse_to_sp(first.plane.frame)
    normal, d = second.plane.normal, second.plane.d
    moved = rotation @ normal
    off = to_sp @ np.append(moved - first.plane.normal, d + shift @ moved - first.plane.d)
    by_motion = np.zeros((4, 6))
    by_motion[:3, :3] = -rotation @ skew(normal)
    by_motion[3, :3], by_motion[3, 3:] = shift @ by_motion[:3, :3], normal
    return off, to_sp @ hesse_jacobian(a_T_b @ second.plane.frame), to_sp @ by_motion
