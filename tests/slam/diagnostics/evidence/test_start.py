"""The start in a prior map against where the map puts it: chi2 when it is honest, evidence when it is not."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors._conventions import SP_TO_POSE3
from slam import PlaneSlam
from slam.diagnostics.evidence.prior import start_evidence, start_innovation
from slam.frontend.keyframes import Keyframe
from slam.geometry.frames import planar_transform
from slam.session.prior_map import PriorMap, floor_start
from spplanes.spmodel import transform_from_rpy
from tests.slam.scenes import drive, room_planes
from tests.slam.session.test_prior_map import as_entry
from tests.statistics import assert_mean_in_band

START_M, START_RAD = 0.1, 0.03


def moved(pose: np.ndarray, differential: np.ndarray) -> np.ndarray:
    """A pose with an SP differential composed on the right, by the exponential."""
    return pose @ gtsam.Pose3.Expmap(differential[SP_TO_POSE3]).matrix()


def test_an_honest_start_is_chi2_in_what_the_map_tells():
    """Start and measurement about one truth, fused: four directions measured, one hardly, one not at all; 400 draws."""
    rng = np.random.default_rng(0)
    half = rng.standard_normal((6, 6)) * 0.01
    stated = half @ half.T + np.diag(np.square([0.03, 0.03, 0.03, 0.01, 0.01, 0.01]))
    axes = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    root = np.linalg.cholesky(stated)
    # in directions of the start's own, variances of 1: information of the map in them
    told = root @ axes
    measured = np.linalg.inv(told).T @ np.diag([1e4, 1e3, 50.0, 9.0, 0.2, 0.0]) @ np.linalg.inv(told)
    covariance = np.linalg.inv(np.linalg.inv(stated) + measured)
    truth = transform_from_rpy((1.0, 2.0, 0.3, 0.5, 0.1, -0.2))
    found = []
    for _ in range(400):
        start = root @ rng.standard_normal(6)
        gain = covariance @ measured
        noise = told @ (np.array([1e-2, 1e3**-0.5, 50.0**-0.5, 9.0**-0.5, 0.2**-0.5, 0.0]) * rng.standard_normal(6))
        estimate = start + gain @ (noise - start)  # in the tangent of the truth
        chi2, dof, _ = start_innovation(moved(truth, start), stated, moved(truth, estimate), covariance)
        assert dof == 4
        found.append(chi2)
    assert_mean_in_band(np.array(found), 4)


def run_from(error: np.ndarray, keyframes: int = 12) -> PlaneSlam:
    """The room as a prior map, and a mission whose start is off by (x, y, heading) of what is stated."""
    scene = drive(7)
    known = [as_entry(*pair) for pair in enumerate(room_planes())]
    start = scene.world_T_body[0] @ planar_transform(*error.tolist())
    covariance = np.diag(np.tile(np.square([0.004, 0.003, 0.003]), len(known)))
    slam = PlaneSlam(prior=PriorMap(known, covariance, start, floor_start(START_M, START_RAD)))
    for keyframe in scene.keyframes[:keyframes]:
        slam.add_keyframe(keyframe)
    return slam


def test_a_start_elsewhere_is_evidence_and_one_within_its_errors_is_none():
    sigmas = np.array([START_M, START_M, START_RAD])
    (honest,) = start_evidence(run_from(sigmas * (0.9, -0.7, 0.8)))
    assert honest.p_value > 0.05
    (wrong,) = start_evidence(run_from(sigmas * (3.3, 3.3, 3.0)))
    assert wrong.p_value < 1e-4 and wrong.keyframes == (0,) and wrong.grade == "doubtful"
    assert wrong.size == pytest.approx(np.hypot(0.33, 0.33), abs=0.03)
    assert "the map's planes put the start 0.4" in wrong.sentence


def test_without_a_prior_or_a_keyframe_there_is_nothing_to_say():
    slam = PlaneSlam()
    assert list(start_evidence(slam)) == []
    slam.add_keyframe(Keyframe(0, []))
    assert list(start_evidence(slam)) == []
