"""PlaneSlam on a room with truth: consistent, associated right, incremental equals batch, its parts, refusals."""

from dataclasses import replace

import gtsam
import numpy as np

from factors import PlaneObservation, plane_landmark
from slam import Keyframe, PlaneSlam, SlamConfig
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.loop_closure.closing import LoopCloser
from slam.mapping.same_plane import same_plane_chi2
from slam.planeslam import pose_symbol
from slam.runs.slam_run import run_slam
from slam.simulation import simulate_mission
from spplanes import Plane
from spplanes.segmentation.scans import Labelled, label_scans
from tests.slam.scenes import drive, overstated, planar_nees, room_planes, run_of
from tests.statistics import assert_mean_in_band


def test_one_landmark_for_every_plane_and_all_matches_right():
    slam = run_of(drive(0).keyframes)
    assert len(slam.landmarks) == 6 and [plane.observations for plane in slam.planes] == [15] * 6
    for landmark in slam.landmarks:
        # the scene lists the planes in the same order in every keyframe
        assert {sighting.observation for sighting in landmark.sightings} == {landmark.sightings[0].observation}


def test_final_poses_and_planes_are_consistent_over_many_runs():
    """NEES of the last pose in the floor plane (3 dof) and of every map plane (3 dof each).

    30 runs: twice or half a covariance is off its band in 98 of 100, half as much again in 61; a sign always.
    """
    poses, planes = [], []
    for seed in range(30):
        scene = drive(seed)
        slam, last = run_of(scene.keyframes), len(scene.keyframes) - 1
        covariance, estimate = slam.marginal_covariance(pose_symbol(last)), slam.trajectory.poses[last]
        poses.append(planar_nees(covariance, scene.world_T_body[last], estimate))
        for map_plane in slam.planes:
            truth = max(room_planes(), key=lambda plane: plane.normal @ map_plane.plane.normal)
            planes.append(map_plane.plane.mahalanobis(truth))
    assert_mean_in_band(np.array(poses), 3)
    # planes of one run share poses, so they are not independent: the band of 30 runs, not of 180 planes
    assert_mean_in_band(np.array(planes).reshape(30, 6).mean(axis=1), 3)


def test_the_audit_finds_an_honest_run_consistent_and_an_over_confident_one_not():
    summary = run_of(drive(1).keyframes).audit.summary()[0]
    assert summary.kind == "plane" and summary.count == 14 * 6 and summary.verdict == "consistent"
    lying = run_of(overstated(drive(1).keyframes, 2.0))
    assert lying.audit.summary()[0].verdict == "over-confident" and "over-confident" in lying.audit.warnings()[0]


def test_batch_and_incremental_agree():
    slam = run_of(drive(2).keyframes)
    batch = slam.optimize_batch()
    for index in range(15):
        np.testing.assert_allclose(batch.atPose3(pose_symbol(index)).matrix(), slam.trajectory.poses[index], atol=2e-4)


def test_a_wall_seen_from_behind_is_another_landmark():
    scene, wall = drive(4), room_planes()[3]
    slam, behind = run_of(scene.keyframes), wall.frame.copy()
    behind[:3, 1:3] *= -1.0
    plane = Plane(inverse(scene.world_T_body[-1]) @ behind, np.diag([1e-4] * 3), 500, wall.outline)
    seen, still = [PlaneObservation(plane)], Motion(np.eye(4), 1e-6 * np.eye(3), (1e-3, 1e-3, 1e-3))
    report = slam.add_keyframe(Keyframe(scene.keyframes[-1].stamp_ns + 1, seen, still))
    assert report.decisions[0].verdict == "new"


def test_twins_are_found_by_chi2_and_joined_with_their_factors():
    scene = drive(5)
    slam = run_of(scene.keyframes)
    landmarks = list(slam.landmarks)
    assert same_plane_chi2(landmarks[0], landmarks[1], slam.backend) > 1e3
    # split a landmark by hand: the later half of its sightings under a new key
    old, initial = landmarks[2], gtsam.Values()
    later = old.sightings[8:]
    seen = [scene.keyframes[one.keyframe].observations[one.observation] for one in later]
    plane, anchor = seen[0].full_plane(0.01), pose_symbol(later[0].keyframe)
    copy = slam.landmarks.birth(seen[0], anchor, plane.frame, inverse(plane.frame))
    initial.insert(copy.key, plane_landmark(plane))
    poses = [pose_symbol(one.keyframe) for one in later]
    factors = [one.factor(pose, copy.key, anchor) for one, pose in zip(seen, poses, strict=True)]
    indices = slam.backend.update(factors, initial, remove=[s.factor_index for s in later])
    copy.sightings += [replace(s, factor_index=i) for s, i in zip(later, indices, strict=True)]
    old.sightings[8:] = []
    slam.landmarks.refresh(slam.backend)
    before = slam.trajectory.poses.copy()
    assert slam._same_plane.pairs({copy.id}) == [(old.id, copy.id)]
    slam._merge_same_planes({copy.id})
    assert len(slam.landmarks) == 6 and old.n_keyframes == 15 and not slam.backend.values.exists(copy.key)
    np.testing.assert_allclose(slam.trajectory.poses, before, atol=5e-3)
    np.testing.assert_allclose(slam.trajectory.poses, run_of(scene.keyframes).trajectory.poses, atol=1e-4)


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
    assert len(run.slam.landmarks) == 0 and len(run_slam(mission.log, mission.rig, SlamConfig()).slam.landmarks) > 0
