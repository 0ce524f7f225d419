"""Loops closed in simulated floor plans: the drive ends where it should, and no wall is taken for another."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.corpus.floorplan import Drive, LaserSettings, Wheels, drive, office, ring, wrong_landmarks
from slam import PlaneSlam, SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.geometry.frames import inverse
from slam.io.default_rigs import default_rig_for
from slam.runs.slam_run import odometry_of
from tests.slam.scenes import run_of


def estimate(truth: Drive) -> tuple[PlaneSlam, np.ndarray, np.ndarray]:
    """The run, and the errors (N,) of its poses and of odometry alone, the first pose given, m."""
    rig = default_rig_for(truth.log)
    slam = run_of(keyframes_of(truth.log, rig, SlamConfig()))
    paths = slam.trajectory, odometry_of(truth.log, rig, slam.trajectory)
    errors = [inverse(path.poses[0]) @ path.poses - truth.poses_at(path.stamps_ns) for path in paths]
    return slam, *(np.linalg.norm(one[:, :2, 3], axis=1) for one in errors)


@pytest.mark.parametrize(("seed", "doors", "curvature"), [(0, 4, 0.03), (1, 2, -0.04), (2, 3, 0.0)])
def test_the_loop_of_a_block_of_corridors_closes(seed, doors, curvature):
    rng = np.random.default_rng(seed)
    plan = ring(rng, length_m=14.0, depth_m=9.0, doors_per_wall=doors)
    truth = drive(plan, rng, LaserSettings(), Wheels(scale=0.04, curvature_rad_per_m=curvature))
    slam, errors, odometry = estimate(truth)
    assert odometry.max() > 0.8
    assert errors.max() < 0.5  # along corridors with few doors, before the loop is closed, wheels alone tell the way
    assert errors[-1] < 0.25
    assert wrong_landmarks(slam, truth, 0.2) == []
    assert len(wrong_landmarks(slam, truth)) <= 4  # door leaves stand 12 cm back: some are taken for the wall
    first = {one.id for one in slam.landmarks if one.sightings[0].keyframe < 8}
    assert any(slam.landmarks[one].sightings[-1].keyframe > len(slam.keyframes) - 8 for one in first)
    assert slam.audit.mean_per_dof < 1.1


def test_rooms_with_clutter_are_the_same_rooms_on_the_second_round():
    rng = np.random.default_rng(5)
    truth = drive(office(rng, n_rooms=2), rng, LaserSettings(n_beams=180, range_max_m=30.0))
    slam, errors, odometry = estimate(truth)
    assert odometry.max() > 0.8
    assert errors.max() < 0.2
    assert wrong_landmarks(slam, truth, 0.2) == []
