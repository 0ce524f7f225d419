"""Planes are linearised where they are: level or parallel ones must not fix what they leave open."""

from __future__ import annotations

import numpy as np

from slam.backend.estimator import pose_symbol
from slam.config import SlamConfig
from slam.geometry.frames import inverse
from slam.runs.slam_run import run_slam
from slam.simulation.drives import Recipe, make_drive


def test_a_floor_does_not_say_where_along_it_the_body_is():
    """A push-broom laser alone: 0.55 m off for a claimed 0.03 m with planes linearised to 10 mrad, 0.11 m with 0.1."""
    drive = make_drive(Recipe.parse("hall/pushbroom/good"), 960010)
    run = run_slam(drive.log, drive.rig, SlamConfig())
    values = run.slam.backend.values
    step = run.slam.backend.graph.linearize(values).optimize()  # where the estimate is, not where iSAM2 linearised
    poses = [pose_symbol(index) for index in range(len(run.trajectory.poses))]
    assert max(np.abs(step.at(key)[3:]).max() for key in poses) < 0.05
    true = drive.truth.poses_at(run.trajectory.stamps_ns)
    found = true[0] @ inverse(run.trajectory.poses[0]) @ run.trajectory.poses
    assert np.linalg.norm((found - true)[:, :3, 3], axis=1).max() < 0.2
