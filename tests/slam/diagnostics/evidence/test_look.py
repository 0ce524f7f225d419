"""The verdict of whole runs: right ones are sound, ones that are wrong in a known way are not, and say which."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factors.association.observations import PlaneObservation
from slam import PlaneSlam, SlamConfig
from slam.diagnostics.evidence import assess_run
from slam.diagnostics.evidence.surfaces import free_space_evidence
from slam.diagnostics.views import scan_views_of
from slam.geometry.frames import planar_transform
from slam.map.data_association import Decision
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import Log, OdometryReading
from slam.sensors.rig import Mount, Rig
from slam.session.prior_map import PriorMap, floor_start, map_covariance
from slam.simulation import simulate_mission
from spplanes import Plane
from tests.slam.scenes import drive, measured, room_planes, run_of, with_sensors


@cache
def hall(seed: int = 3) -> tuple[Log, Rig]:
    mission = simulate_mission("hall", n_scans=16, seed=seed)
    return mission.log, mission.rig


def turned(rig: Rig) -> Rig:
    """The rig with its sensor backwards."""
    (sensor,) = rig.sensors.values()
    return with_sensors(rig, mount=Mount.of(sensor.body_T_sensor @ Mount(rpy_deg=(0.0, 0.0, 180.0)).as_matrix()))


@pytest.fixture(scope="module")
def right() -> Run:
    return run_slam(*hall(), SlamConfig())


def test_a_right_run_is_sound_and_reading_it_changes_nothing(right: Run):
    before, verdict = right.slam.trajectory.poses, assess_run(right.slam, right.rig)
    assert verdict == assess_run(right.slam, right.rig) == right.verdict
    assert (verdict.verdict, verdict.reasons) == ("sound", [])
    np.testing.assert_array_equal(right.slam.trajectory.poses, before)


def test_scans_at_right_poses_are_no_evidence_and_a_jump_in_them_is(right: Run):
    """Nothing but what 3D scans see from one keyframe, against what others saw."""
    poses = right.slam.trajectory.poses
    views = scan_views_of(right.slam.keyframes, poses)
    assert len(views) == len(poses) and list(free_space_evidence(views, poses)) == []
    bent = poses.copy()
    bent[8:] = planar_transform(-0.6, 0.4, 0.0) @ bent[8:]
    (found,) = free_space_evidence(views, bent)
    assert found.p_value < 1e-4 and found.size > 0.15 and min(found.keyframes) < 8 <= max(found.keyframes)


def test_odometry_that_stands_still_is_refuted_by_the_scans_and_harms_nothing(right: Run):
    log, rig = hall()
    first = log.odometry[0].odom_T_body
    events = [OdometryReading(one.stamp_ns, first) if isinstance(one, OdometryReading) else one for one in log.events]
    still = run_slam(replace(log, events=events), rig, SlamConfig())
    off = np.linalg.norm(still.trajectory.poses[:, :3, 3] - right.trajectory.poses[:, :3, 3], axis=1)
    assert off.max() < 0.05 and assess_run(still.slam, rig).verdict == "sound"


def test_what_matches_nothing_is_no_sound_run():
    """An association that takes everything for new: poses are odometry's, and no wall is seen twice."""
    log, rig = hall()

    def nothing(observations, *state, **how):
        return [Decision(number, "new", None, ()) for number in range(len(observations))]

    verdict = assess_run(run_slam(log, rig, SlamConfig(), slam=PlaneSlam(associate=nothing)).slam, rig)
    assert verdict.verdict != "sound"
    assert any(one.kind == "unmatched" and "match nothing" in one.sentence for one in verdict.evidence)


@pytest.mark.parametrize(("n_points", "speaks"), [(20, False), (500, True)])
def test_what_may_start_no_landmark_says_nothing_where_it_matches_nothing(n_points: int, speaks: bool):
    """At every keyframe 40 m^2 of planes at random beside the room's 180: of few points they are clutter."""
    rng, frames = np.random.default_rng(5), []
    for frame in drive(0).keyframes:
        normals, outline = rng.standard_normal((10, 3)), room_planes()[2].outline
        things = [Plane.from_hesse(n / np.linalg.norm(n), rng.uniform(0.5, 3.0), np.zeros((4, 4))) for n in normals]
        clutter = [PlaneObservation(measured(replace(one, n_points=n_points, outline=outline), rng)) for one in things]
        frames.append(replace(frame, observations=[*frame.observations, *clutter]))
    kinds = [one.kind for one in assess_run(run_of(frames), hall()[1]).evidence]
    assert ("unmatched" in kinds) == speaks


def test_a_3d_sensor_backwards_is_broken_and_named():
    log, rig = hall()
    verdict = assess_run(run_slam(log, turned(rig), SlamConfig()).slam, turned(rig))
    assert verdict.verdict == "broken" and "mounted backwards" in verdict.reasons[0]
    assert "nothing tells that from one mounted upside down" in verdict.reasons[0]  # a drive without turns


def test_a_prior_map_is_confirmed_from_its_start_and_not_from_another(right: Run):
    covariance = map_covariance(right.planes, right.slam.landmarks, right.slam.backend)
    log, rig = hall(seed=4)
    for start, is_right in ((np.eye(4), True), (planar_transform(2.0, 1.0, 0.7), False)):
        prior = PriorMap(right.planes, covariance, right.trajectory.poses[0] @ start, floor_start())
        again = run_slam(log, rig, SlamConfig(), slam=PlaneSlam(SlamConfig(), prior=prior))
        assert (assess_run(again.slam, rig).verdict == "sound") == is_right


def test_too_few_keyframes_and_an_empty_map_are_doubtful():
    slam, rig = PlaneSlam(), hall()[1]
    assert "has only 0 keyframes" in assess_run(slam, rig).reasons[0]
    run_of((replace(one, observations=[]) for one in drive(0, count=5).keyframes), slam)
    verdict = assess_run(slam, rig)
    assert (verdict.verdict, verdict.evidence[0].keyframes) == ("doubtful", (0, 1, 2, 3, 4))
    assert "the map is empty" in verdict.reasons[0]


def test_observations_that_match_nothing_leave_keyframes_to_odometry():
    frames = drive(0, count=12).keyframes
    slam = run_of([*frames[:4], *(replace(frame, observations=[]) for frame in frames[4:])])
    (reason,) = assess_run(slam, hall()[1]).reasons
    assert "8 of 11 keyframes saw no wall that was known (keyframes 4 to 11)" in reason


def test_odometry_worse_than_stated_counts_where_the_poses_rest_on_it():
    slam, rig, rng = PlaneSlam(), hall()[1], np.random.default_rng(0)
    for index, keyframe in enumerate(drive(1, count=40, turns=3.0).keyframes):
        motion = keyframe.motion
        seen = keyframe.observations[2:4] if index else keyframe.observations  # two walls that face each other
        if motion is not None:
            error = 4.0 * np.linalg.cholesky(motion.covariance) @ rng.standard_normal(3)
            motion = replace(motion, a_T_b=motion.a_T_b @ planar_transform(*error))
        slam.add_keyframe(replace(keyframe, motion=motion, observations=seen))
    (found,) = [one for one in assess_run(slam, rig).evidence if one.kind == "odometry"]
    assert 1.5 < found.size < 6.0 and "times as much as stated" in found.sentence
