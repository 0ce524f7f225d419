"""PlaneSlam with other parts: association, loop closer and segmentation are arguments, and are really used."""

from __future__ import annotations

import numpy as np

from slam import PlaneSlam, SlamConfig
from slam.loop_closure.closing import LoopCloser
from slam.map.data_association import associate
from slam.runs.slam_run import run_slam
from slam.simulation import simulate_mission
from spplanes.segmentation.scans import Labelled, label_scans
from tests.slam.scenes import drive, run_of


def test_an_association_that_hands_on_to_ours_changes_nothing():
    scene, calls = drive(0), []

    def counted(*state, **how):
        calls.append(how)
        return associate(*state, **how)

    plain, other = run_of(scene.keyframes), run_of(scene.keyframes, PlaneSlam(associate=counted))
    assert len(calls) >= len(scene.keyframes)
    np.testing.assert_array_equal(other.trajectory.poses, plain.trajectory.poses)


def test_a_loop_closer_is_asked_after_every_keyframe():
    looks = []

    class Counting(LoopCloser):
        def look(self, scale):
            looks.append(scale)

    scene = drive(0)
    slam = run_of(scene.keyframes, PlaneSlam(loop_closer=Counting))
    assert len(looks) == len(scene.keyframes) and slam.loops == []


def test_a_segmentation_that_finds_nothing_leaves_the_map_empty():
    mission = simulate_mission("hall", n_scans=2, seed=0)

    def nothing(points, covariances, /, **how):
        found = label_scans(points, covariances, **how)
        return Labelled(found.points, found.covariance, np.full_like(found.labels, -1), found.views, found.poses)

    run = run_slam(mission.log, mission.rig, SlamConfig(), slam=PlaneSlam(segment=nothing))
    assert len(run.slam.landmarks) == 0
    assert len(run_slam(mission.log, mission.rig, SlamConfig()).slam.landmarks) > 0
