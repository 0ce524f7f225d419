"""The back end: what is read of the map at the end is what the estimate works with."""

from __future__ import annotations

import numpy as np
import pytest

from slam.backend import estimator
from slam.backend.estimator import pose_symbol
from tests.slam.short_drives import mapped_beginning


def test_covariances_read_are_those_of_the_estimate_whoever_asked_before() -> None:
    run, _ = mapped_beginning("irregular/lidar16", 7, 6)
    slam = run.slam
    landmarks = [one for one in slam.landmarks if one.n_keyframes > 1][:12]
    keys = sorted({key for one in landmarks for key in (one.key, one.anchor_key)} | {pose_symbol(5)})
    assert len(landmarks) > 5
    before = slam.backend.read_joint_covariance(keys[:3]).full
    used = slam.backend.joint_covariance(keys)
    np.testing.assert_array_equal(slam.backend.read_joint_covariance(keys[:3]).full, before)
    sigmas = np.sqrt(np.diag(before))
    np.testing.assert_allclose(
        used.of(keys[:3]) / np.outer(sigmas, sigmas), before / np.outer(sigmas, sigmas), atol=1e-6
    )


def test_a_covariance_of_many_variables_is_the_same_by_the_graph_as_by_the_tree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, _ = mapped_beginning("irregular/lidar16", 7, 6)
    backend = run.slam.backend
    keys = sorted({key for one in run.slam.landmarks for key in (one.key, one.anchor_key)})
    found = []
    for many in (0, len(keys)):
        monkeypatch.setattr(estimator, "_MANY", many)
        backend.settle(1)  # nothing is remembered
        found.append(backend.joint_covariance(keys).full)
    sigmas = np.sqrt(np.diag(found[0]))
    assert len(keys) > 15
    np.testing.assert_allclose(found[0] / np.outer(sigmas, sigmas), found[1] / np.outer(sigmas, sigmas), atol=1e-6)
