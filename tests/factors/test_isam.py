"""Covariances out of iSAM2 against those of a batch at the same estimate."""

import gtsam
import numpy as np
import pytest

from factors import (
    isam_covariance,
    joint_covariance,
    plane_factor,
    pose_prior,
    relative_pose_factor,
)
from spplanes import Plane
from tests.factors.factor_scenes import TIED_NORMALS, A, L, X, frame_of


def run(normal):
    """iSAM2, its graph and estimate: an anisotropic plane, linearised a little to the other side of the tie."""
    plane = Plane(frame_of(normal, 2.0 * normal, 0.3), np.diag([1e-6, 1e-7, 1e-4]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(pose_prior(A, np.eye(4), np.diag([1, 2, 3, 4, 5, 6]) * 1e-6))
    graph.push_back(relative_pose_factor(A, X, np.eye(4), np.diag([6, 5, 4, 3, 2, 1]) * 1e-6))
    graph.push_back(plane_factor(plane, X, L, anchor_key=A))
    values.insert(A, gtsam.Pose3())
    values.insert(X, gtsam.Pose3())
    turned = plane.frame[:3, :3] @ gtsam.Rot3.RzRyRx(2e-3, -3e-3, 0.0).matrix()
    values.insert(L, gtsam.OrientedPlane3(gtsam.Unit3(turned[:, 2]), -plane.d))
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.1)
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, values)
    return isam, graph, isam.calculateEstimate()


@pytest.mark.parametrize("keys", [(A, L), (L, X, A), (L,)])
def test_isam_covariance_is_that_of_a_batch_at_the_estimate(keys):
    turned = 0
    for normal in TIED_NORMALS:
        isam, graph, estimate = run(normal)
        marginals = gtsam.Marginals(graph, estimate)
        batch = joint_covariance(marginals, list(keys))
        scale = np.sqrt(np.diag(batch))
        scale = np.outer(scale, scale)
        np.testing.assert_allclose(isam_covariance(isam, estimate, keys) / scale, batch / scale, atol=0.05)
        turned += np.abs(isam.jointMarginalCovariance(list(keys)).fullMatrix() / scale - batch / scale).max() > 0.5
    assert turned >= 4  # or the bases never jumped, and the test says nothing


def test_bad_keys():
    isam, _, estimate = run(np.array([0.0, 0.0, 1.0]))
    for keys, message in (
        (("x", L), r"keys: expected a GTSAM key"),
        ((L, L), r"keys\[1\]: expected another key than keys\[0\]"),
        ((gtsam.symbol("q", 0),), "keys: expected variables of isam and of values, got"),
        ((), "keys: expected at least one, got none"),
    ):
        with pytest.raises(ValueError, match=message):
            isam_covariance(isam, estimate, keys)
    with pytest.raises(ValueError, match="isam: expected an ISAM2, got Values"):
        isam_covariance(estimate, estimate, (L,))
