"""Consistency without a prediction: innovations of a keyframe whose pose only its own observations tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factors.association.gating import hypotheses_of
from slam.association.data_association import Decision
from slam.backend.estimator import Backend
from slam.frontend.observations import Observation
from slam.map.landmarks import LandmarkMap
from spplanes._check import FloatArray

#: A motion of the pose that moves no measurement by more than this many of its sigmas a metre or radian is not found.
_SILENT = 1e-2


def innovations_without_prediction(
    observations: Sequence[Observation],
    decisions: Sequence[Decision],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
) -> list[tuple[int, float, int]]:
    """(index of the observation, chi2, degrees of freedom) of every match, without what was known of the pose before.

    Where no odometry is, the pose of a keyframe is found by its planes: a prediction made of them agrees with them, and
    a wide one with anything. So the pose is taken as unknown. What the matches say beyond finding it has to agree
    within the covariance of measurements and map, which is chi2 with six degrees of freedom less where they fix
    everything. An observation has the share that it adds to those firmer than it. To be asked before the keyframe's
    factors are in the graph.
    """
    found = [(one.observation, one.match.landmark) for one in decisions if one.match is not None]
    found.sort(key=lambda pair: (-observations[pair[0]].n_points, pair[0]))
    if not found:
        return []
    keys = sorted({pose_key, *(key for _, i in found for key in (landmarks[i].key, landmarks[i].anchor_key))})
    joint, values = backend.joint_covariance(keys), backend.values_of(keys)
    rows, residuals = [], []
    for index, landmark in found:
        [hypothesis] = hypotheses_of(observations[index], [landmarks[landmark]], pose_key, joint, values, backend)
        rows.append(np.zeros((len(hypothesis.target), len(joint.full))))
        rows[-1][:, hypothesis.columns] = hypothesis.jacobian
        residuals.append(hypothesis.target)
    residual, by_pose = _whitened(np.vstack(rows), np.concatenate(residuals), joint.full, joint.columns([pose_key]))
    ends = np.cumsum([0, *map(len, residuals)]).tolist()
    left = [_left_over(residual[:end], by_pose[:end]) for end in ends]
    shares = zip(found, left[1:], left[:-1], strict=True)
    return [(index, max(chi2 - before, 0.0), dof - used) for (index, _), (chi2, dof), (before, used) in shares]


def _whitened(
    jacobian: FloatArray, residual: FloatArray, covariance: FloatArray, of_pose: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n,) and their derivative by the pose (n, 6), in units of what measurements and map let them be.

    A row depends on no residual after its own.
    """
    by_map = jacobian.copy()
    by_map[:, of_pose] = 0.0
    root = np.linalg.cholesky(by_map @ covariance @ by_map.T + np.eye(len(residual)))
    both: FloatArray = np.asarray(np.linalg.solve(root, np.column_stack((residual, jacobian[:, of_pose]))), float)
    return both[:, 0], both[:, 1:]


def _left_over(residual: FloatArray, by_pose: FloatArray) -> tuple[float, int]:
    """What no pose explains of whitened residuals (n,) that depend on it by (n, 6): chi2 and degrees of freedom."""
    axes, sizes, _ = np.linalg.svd(by_pose, full_matrices=False)
    explained = axes[:, sizes > _SILENT].T @ residual
    return float(residual @ residual - explained @ explained), len(residual) - len(explained)
