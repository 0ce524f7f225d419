"""Laser odometry: how good its motions are, whether they err as they say, and what it makes of wheels that lie."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.config import CoastingConfig, SlamConfig
from slam.errors import LogError
from slam.frontend.information import information_beyond_lines, inverted
from slam.frontend.keyframes import keyframes_of
from slam.frontend.keyframes import track_of as made_track
from slam.frontend.laser_odometry import tracker
from slam.frontend.laser_odometry.local_map import LocalMap, Surface
from slam.frontend.laser_odometry.matching import Expected, Match, match_scan
from slam.frontend.laser_odometry.track import LaserTrack, Step, between_scans, motion_between
from slam.frontend.laser_odometry.tracker import LaserOdometry, NoiseScale, laser_track
from slam.frontend.occupancy.raster import free_standing
from slam.frontend.odometry import Motion, OdometryTrack, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.io.default_rigs import default_rig_for
from slam.runs.slam_run import run_slam
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.sensors.rig import Mount, Rig, Sensor
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS as NOISE
from tests.slam.laser_floors import PATCH_M, Drive, FloorPlan, Wheels, cast, drive
from tests.slam.scenes import with_sensors
from tests.slam.short_drives import errors_of as drive_errors
from tests.slam.short_drives import mapped_beginning, until

GAP = 5  # scans from one end of a motion that is judged to the other: half a metre, or half a radian
LASER = Sensor(kind="line", range_sigma_m=0.01, range_max_m=8.0)
NO_SLIPS = Wheels(n_slips=0)


def rooms(seed: int, wheels: Wheels = NO_SLIPS) -> Drive:
    """Two rooms with boxes and a door between them, there and back again."""
    rng, plan = np.random.default_rng(seed), FloorPlan()
    outer = [(0.0, 0.0), (5.0, 0.0), (5.0, 1.6), (5.1, 1.6), (5.1, -0.4), (9.5, -0.4), (9.5, 4.0), (5.1, 4.0)]
    plan.add_chain([*outer, (5.1, 2.6), (5.0, 2.6), (5.0, 4.5), (0.0, 4.5), (0.0, 0.0)])
    for x in (0.4, 2.3, 6.3, 8.6):
        plan.add_box(x + rng.uniform(0.0, 0.4), rng.uniform(3.0, 3.3), 0.5, 0.4)
    plan.way = [(1.0, 1.0), (3.5, 1.2), (4.0, 2.1), (7.0, 2.1), (8.5, 1.0), (7.0, 2.1), (4.0, 2.1), (1.0, 2.2)]
    return drive(plan, rng, wheels=wheels)


def stated(log: Log) -> Rig:
    """A rig that knows what the simulator does."""
    noise = {"range_sigma_m": 0.01, "surface_sigma_m": 0.005, "surface_correlation_m": PATCH_M}
    return with_sensors(default_rig_for(log), **noise)


def track_of(log: Log) -> LaserTrack:
    return laser_track(log, stated(log), CoastingConfig())


def scans_alone(log: Log) -> Log:
    return replace(log, events=log.scans())


def with_scans(log: Log, scans: list[LaserScan]) -> Log:
    """With these alone of its scans."""
    kept = {id(scan) for scan in scans}
    return replace(log, events=[one for one in log.events if isinstance(one, OdometryReading) or id(one) in kept])


def errors_of(track: OdometryTrack, truth: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 3) of motions over half a metre, and their NEES by wheels and returns together."""
    errors, nees = [], []
    stamps = [scan.stamp_ns for scan in truth.log.scans()]
    for first in range(0, len(stamps) - GAP, GAP):
        motion = track.motion(stamps[first], stamps[first + GAP])
        true = inverse(truth.poses[first]) @ truth.poses[first + GAP]
        errors.append(planar_delta(inverse(true) @ motion.a_T_b))
        if motion.scan_matched is not None:
            nees.append(errors[-1] @ np.linalg.solve(motion.scan_matched.covariance, errors[-1]))
    return np.array(errors), np.array(nees)


def end_error_m(track: OdometryTrack, truth: Drive) -> float:
    scans = truth.log.scans()
    first, last = track.poses_at([scans[0].stamp_ns, scans[-1].stamp_ns])
    found, true = inverse(first) @ last, inverse(truth.poses[0]) @ truth.poses[-1]
    return float(np.linalg.norm((found - true)[:2, 3]))


@pytest.mark.parametrize("with_wheels", [True, False], ids=["wheels", "scans alone"])
def test_motions_err_by_millimetres_and_by_no_more_than_they_say(with_wheels: bool):
    drives = [rooms(seed) for seed in range(4)]
    found = [errors_of(track_of(one.log if with_wheels else scans_alone(one.log)), one) for one in drives]
    errors, nees = (np.concatenate(part) for part in zip(*found, strict=True))
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.004  # m and rad
    # 3 is honest; ends of a short way share the errors of the wall between them, which is not claimed
    assert 0.1 < nees.mean() < 3.0 * (1.0 + 3.0 * np.sqrt(2.0 / (3.0 * len(nees))))
    assert np.mean(nees > 16.3) < 0.01  # a thousandth is honest


@pytest.mark.parametrize("slip_rad", [0.35, -0.35])
def test_a_slip_of_twenty_degrees_is_the_wheels_own(slip_rad: float):
    truth = rooms(5, Wheels(slip_rad=slip_rad, slip_m=0.2, n_slips=2))
    track, wheels = track_of(truth.log), OdometryTrack(truth.log.odometry, stated(truth.log).odometry)
    assert end_error_m(track, truth) < 0.03 and end_error_m(wheels, truth) > 0.5
    errors, nees = errors_of(track, truth)
    assert np.abs(errors).max() < 0.03 and nees.mean() < 3.0


@pytest.mark.parametrize("seed", range(3))
def test_half_a_turn_that_neither_scans_nor_wheels_saw_is_found_at_the_first_scan_after_it(seed: int):
    """Three seconds without a scan; the reading after them is still that from before, as odometry that lags is."""
    truth = rooms(seed)
    stamps = np.array([scan.stamp_ns for scan in truth.log.scans()])
    blind = round(3e9 / np.diff(stamps).min())
    headings = np.unwrap(np.arctan2(truth.poses[:, 1, 0], truth.poses[:, 0, 0]))
    start = int(np.argmax(np.abs(headings[blind:] - headings[:-blind])))
    first, last = int(stamps[start]), int(stamps[start + blind])
    stale = next(event.odom_T_body for event in truth.log.odometry if event.stamp_ns == first)
    events = [event for event in truth.log.events if not first < event.stamp_ns < last]
    lagging = [
        replace(event, odom_T_body=stale) if isinstance(event, OdometryReading) and event.stamp_ns == last else event
        for event in events
    ]
    track = track_of(replace(truth.log, events=lagging))
    found = inverse(track.poses_at([first])[0]) @ track.poses_at([last])[0]
    error = planar_delta(inverse(inverse(truth.poses[start]) @ truth.poses[start + blind]) @ found)
    assert abs(headings[start + blind] - headings[start]) > 2.5 and np.abs(error).max() < 0.02
    assert end_error_m(track, truth) < 0.03


def test_what_fits_elsewhere_as_well_leaves_the_wheels_in_doubt_too():
    """Two like bays of a long wall: which one it is stays open, in all that is said."""
    surface, odometry = scan_in((1.0, 1.0, 0.0)), LaserOdometry(NOISE, CoastingConfig())
    odometry.add(0, surface, None)
    sure, spread = odometry.add(100_000_000, surface, np.zeros(3)), np.diag((0.25, 0.0, 0.0))
    with pytest.MonkeyPatch.context() as patch:
        torn = Match(sure.pose, 1e4 * np.eye(3), 0.9, 0.0, 0, 0.5, spread)
        patch.setattr(tracker, "match_scan", lambda *given: torn)
        step = odometry.add(200_000_000, surface, np.zeros(3))
        unlike = replace(torn, fit=0.05, information=np.zeros((3, 3)))
        patch.setattr(tracker, "match_scan", lambda *given: unlike)
        lost = odometry.add(300_000_000, surface, np.zeros(3))
    for one in (step, lost):
        assert one.wheels[0, 0] > 0.5 and one.wheels[1, 1] < 0.01 and one.returns[0, 0] < 2.1
    assert np.array_equal(lost.pose, step.pose)  # what does not fit moves nothing


def fan(things: list[tuple[float, float, float]]) -> Surface:
    """A wall five metres ahead, and things before it: from bearing to bearing, rad, at a distance, m."""
    angles = np.linspace(-0.9, 0.9, 361)
    ranges = 5.0 / np.cos(angles)
    for first, last, distance in things:
        ranges = np.where((angles >= first) & (angles <= last), distance, ranges)
    return Surface.of(LaserScan(0, "FLASER", ranges, angles), LASER)


def test_a_thing_that_stands_free_is_one_look_and_a_wall_is_not():
    free, wide = fan([(-0.1, 0.1, 3.0)]), fan([(-0.4, 0.4, 3.0)])
    near = np.hypot(*free.points.T) < 3.01
    assert near.sum() > 30 and free.looks[near].sum() == pytest.approx(1.0)
    assert np.all(free.looks[~near] == free.looks[0])
    assert np.all(wide.looks == wide.looks[0])  # two metres and a half: nobody carries that about
    beside = fan([(-0.1, 0.1, 4.95)])  # a board on the wall
    assert np.all(beside.looks == beside.looks[0])
    nearer = fan([(-0.1, 0.1, 3.0), (0.1, 0.4, 2.0)])  # half hidden: how wide it is nobody knows
    hidden = np.abs(np.hypot(*nearer.points.T) - 3.0) < 0.01
    assert np.all(nearer.looks[hidden] == nearer.looks[0])


def things_of(ranges: np.ndarray, angles: np.ndarray) -> np.ndarray:
    away = ranges[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return free_standing(away, float(angles[1] - angles[0]))


def test_what_stands_free_in_a_fan_and_in_a_whole_circle():
    """A room is nothing that stands free; a thing across the seam of a circle is one, and what a fan's end cuts off."""
    circle = np.linspace(-np.pi, np.pi, 721)[:-1]
    room = 2.5 / np.maximum(np.abs(np.cos(circle)), np.abs(np.sin(circle)))
    assert np.all(things_of(room, circle) == -1)
    for middle in (0.7, np.pi):  # ahead, and across the seam
        person = np.where(np.abs(np.remainder(circle - middle + np.pi, 2 * np.pi) - np.pi) < 0.1, 1.5, room)
        things = things_of(person, circle)
        assert set(things[person == 1.5].tolist()) == {0} and np.all(things[person != 1.5] == -1)
    fan = circle[180:540]
    cut = np.where(fan < fan[0] + 0.1, 1.5, room[180:540])
    assert np.array_equal(things_of(cut, fan) == 0, cut == 1.5) and np.all(things_of(room[180:540], fan) == -1)
    assert np.all(things_of(np.ones(2), fan[:2]) == -1) and len(free_standing(np.empty((0, 2)), 0.01)) == 0


def corridor(rng: np.random.Generator) -> Surface:
    """Two bare walls, 1.2 m to either side: from anywhere along them the same."""
    angles = np.linspace(-np.pi, np.pi, 361)[:-1]
    with np.errstate(divide="ignore"):
        ranges = 1.2 / np.abs(np.sin(angles))
    ranges = np.where(ranges < 8.0, ranges + 0.01 * rng.standard_normal(len(angles)), np.nan)
    return Surface.of(LaserScan(0, "FLASER", ranges, angles), LASER)


def test_walls_tell_nothing_along_them_however_much_their_normals_err():
    """Five centimetres were claimed of it: a drive of 58 keyframes along a bare corridor was 14 m off, and sound."""
    rng, known = np.random.default_rng(2), np.diag((0.05, 0.05, 0.02)) ** 2
    for _ in range(20):
        there = LocalMap(tuple((corridor(rng), np.array((0.25 * k, 0.0, 0.0))) for k in range(8)))
        match = match_scan(corridor(rng), there, [Expected(np.array((2.0, 0.02, 0.005)), known, 1.0)], 0.9)
        sigmas = 1.0 / np.sqrt(np.diag(match.information) + 1e-3)  # of each where the others are known
        assert sigmas[0] > 0.5 and sigmas[1] < 0.01 and sigmas[2] < 0.005
        assert np.abs(match.pose[1:]).max() < 0.01
        assert abs(match.pose[0] - 2.0) < 0.1  # within two standard deviations of what was expected


def test_odometry_that_stands_still_is_not_believed():
    truth = rooms(6)
    moving = truth.log.odometry[: len(truth.log.odometry) // 3]
    still = [replace(one, odom_T_body=moving[-1].odom_T_body) for one in truth.log.odometry[len(moving) :]]
    log = replace(truth.log, events=sorted([*moving, *still, *truth.log.scans()], key=lambda event: event.stamp_ns))
    assert end_error_m(track_of(log), truth) < 0.05 and len(list(keyframes_of(log, stated(log), SlamConfig()))) > 15


def scan_in(pose: tuple[float, float, float], seed: int = 0) -> Surface:
    """A scan in a room of 4 x 3 m with a niche, noise 1 mm."""
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (2.5, 3.0), (2.5, 3.4), (1.5, 3.4), (1.5, 3.0), (0.0, 3.0)]
    walls = np.array(list(zip(corners, [*corners[1:], corners[0]], strict=True)))
    angles = np.linspace(-np.pi / 2, np.pi / 2, 181)
    noise = np.random.default_rng(seed).normal(0.0, 0.001, 181)
    ranges = cast(walls, np.zeros((len(walls), 256)), np.array(pose), angles) + noise
    scan = LaserScan(0, "FLASER", ranges, angles)
    return Surface.of(scan, stated(Log([scan], Path("x"))).sensors["FLASER"])


THERE, BESIDE = (1.2, 1.0, 0.3), (1.0, 1.3, 1.0)


def mapped_room() -> LocalMap:
    """Of that room, by two scans."""
    return LocalMap(((scan_in(THERE), np.array(THERE)), (scan_in(BESIDE, 1), np.array(BESIDE))))


def test_a_scan_is_found_from_beside_and_from_far_off():
    for off, sigma in (((0.05, -0.04, 0.03), 0.05), ((0.5, -0.4, 0.5), 0.4)):
        expected = Expected(np.array(THERE) + off, sigma**2 * np.eye(3), 1.0)
        found = match_scan(scan_in(THERE, 2), mapped_room(), [expected], 0.97)
        np.testing.assert_allclose(found.pose, THERE, atol=2e-3)
        assert found.odds > 0.99 and found.fit > 0.9


def test_the_wheels_are_given_up_only_where_the_returns_refute_them():
    """Constant velocity after a long pause allows any motion: that it ends at the same place is nothing for it."""
    there, rng = np.array(THERE), np.random.default_rng(1)
    sigmas, anywhere = np.array((0.1, 0.1, 0.05)), np.diag([70.0, 70.0, 50.0]) ** 2
    for seed in range(12):
        coasted = Expected(there + rng.standard_normal(3) * 0.3, anywhere, 0.001)
        honest = Expected(there + sigmas * rng.standard_normal(3), np.diag(sigmas**2), 0.999)
        slipped = Expected(there + np.array((0.9, -0.2, 0.5)), np.diag(sigmas**2), 0.999)
        for wheels, way in ((honest, 0), (slipped, 1)):
            found = match_scan(scan_in(THERE, 2 + seed), mapped_room(), [wheels, coasted], 0.97)
            np.testing.assert_allclose(found.pose, there, atol=3e-3)
            assert found.way == way


def test_the_scale_of_the_noise_is_learnt_and_slips_do_not_count_for_it():
    rng, scale = np.random.default_rng(0), NoiseScale()
    wheels, seen, factors = np.diag([1e-4, 1e-4, 1e-4]), np.diag([1e-6, 1e-6, 1e2]), np.array((9.0, 0.25, 1.0))
    for step in range(600):
        true = rng.standard_normal(3) * np.sqrt(factors * np.diag(wheels))
        if step % 50 == 0:
            true[:2] += 0.5  # a slip
        before = scale.scaled(wheels)
        after = inverted(inverted(before) + inverted(seen))
        error = after @ np.linalg.solve(seen, true + rng.standard_normal(3) * np.sqrt(np.diag(seen)))
        scale.learn(error, wheels, after, before)
    assert 5.0 < scale.factors[0] < 13.0  # within the spread of 150 steps, and of a Student t's scale
    assert 0.13 < scale.factors[1] < 0.4
    assert scale.factors[2] == pytest.approx(1.0, abs=0.05)  # never seen, never learnt


def test_what_the_lines_say_is_not_said_twice():
    log = rooms(9).log
    frame = next(one for one in keyframes_of(log, stated(log), SlamConfig()) if one.motion is not None)
    lines, track = frame.observations, track_of(log)
    whole = track.motion(track._stamps[0], frame.stamp_ns)
    assert whole.returns_covariance is not None and len(lines) >= 3
    told, scale, left = inverted(whole.returns_covariance), np.sqrt(np.diag(whole.returns_covariance)), []
    for some in ([], lines[:1], lines):
        beyond = information_beyond_lines(whole, some)
        left.append(np.zeros((3, 3)) if beyond is None else inverted(beyond.covariance))
    for more, less in ((told, left[0]), (told, left[1]), (told, left[2]), (left[1], left[2])):
        assert np.linalg.eigvalsh((more - less) * np.outer(scale, scale)).min() > -1e-2
    shares = [np.trace((told - one) * np.outer(scale, scale)) for one in left]  # of 3, taken off
    assert shares[0] < 0.01 and shares[1] > 0.05 and shares[2] > 1.0
    alone = information_beyond_lines(whole, [])
    assert alone is not None
    np.testing.assert_allclose(alone.covariance, whole.returns_covariance, rtol=1e-2, atol=1e-9)  # no lines: all of it


def between_keyframes(truth: Drive) -> list[tuple[Motion, Motion, Motion]]:
    """Of motions over half a metre those for the graph, those of the wheels, and the matched ones."""
    stamps = [scan.stamp_ns for scan in truth.log.scans()][::GAP]
    track, wheels = track_of(truth.log), OdometryTrack(truth.log.odometry, stated(truth.log).odometry)
    ends = pairwise(stamps)
    return [(motion_between(track, wheels, pair, 1e-6), wheels.motion(*pair), track.motion(*pair)) for pair in ends]


def test_wheels_that_agree_with_the_returns_are_the_factor_and_owe_nothing_to_them():
    found = between_keyframes(rooms(11))
    agreed = [one for one in found if np.array_equal(one[0].a_T_b, one[1].a_T_b)]
    for motion, raw, matched in agreed:
        assert np.linalg.eigvalsh(motion.covariance - raw.covariance).min() > -1e-12  # never surer than stated
        np.testing.assert_array_equal(motion.returns_a_T_b, matched.a_T_b)
    assert len(agreed) >= len(found) - 1


def test_wheels_that_slip_are_not_the_factor():
    off = []
    for motion, raw, matched in between_keyframes(rooms(5, Wheels(slip_rad=0.35, slip_m=0.2, n_slips=2))):
        if not np.array_equal(motion.a_T_b, raw.a_T_b):
            np.testing.assert_array_equal(motion.refuted_a_T_b, raw.a_T_b)  # kept: a wrong mount refutes them too
            assert motion.is_by_returns and motion.is_measured
            off.append(abs(planar_delta(inverse(raw.a_T_b) @ matched.a_T_b)[2]))
    assert 1 <= len(off) <= 4 and max(off) > 0.2


def test_a_laser_upside_down_measures_as_the_right_way_up():
    """Its beams run the other way round; the motions are the same."""
    log = rooms(1).log
    log = replace(log, events=log.scans()[:40])
    turned = [replace(one, ranges=one.ranges[::-1].copy(), angles=-one.angles[::-1].copy()) for one in log.scans()]
    rig, stamps = stated(log), [scan.stamp_ns for scan in turned]
    over = rig.sensors["FLASER"].body_T_sensor @ np.diag([1.0, -1.0, -1.0, 1.0])
    up = laser_track(log, rig, CoastingConfig())
    down = made_track(replace(log, events=turned), with_sensors(rig, mount=Mount.of(over)), SlamConfig())
    assert np.allclose(up.poses_at(stamps), down.poses_at(stamps), atol=2e-3)


def test_between_scans_before_the_first_and_after_the_last_the_wheels_say_how_it_went():
    truth = rooms(10)
    scans = truth.log.scans()
    track, wheels = track_of(with_scans(truth.log, scans[20:-20])), OdometryTrack(truth.log.odometry, NOISE)
    for stamps in ([scans[2].stamp_ns, scans[20].stamp_ns], [scans[-21].stamp_ns, scans[-3].stamp_ns]):
        ours, theirs = (inverse(first) @ last for first, last in (one.poses_at(stamps) for one in (track, wheels)))
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
        assert np.linalg.norm(ours[:3, 3]) > 0.1
    dense = track_of(truth.log)  # at every other scan alone, what the wheels say between is all there is
    half, stamps = track_of(with_scans(truth.log, scans[::2])), [scan.stamp_ns for scan in scans[1:-1:2]]
    off = np.linalg.inv(half.poses_at(stamps)) @ dense.poses_at(stamps)
    assert np.quantile(np.abs(off[:, :2, 3]), 0.9) < 0.006
    np.testing.assert_allclose(half.poses_at([scans[4].stamp_ns])[0], planar_transform(*half._steps[2].pose))
    alone = laser_track(scans_alone(truth.log), stated(truth.log), CoastingConfig())
    assert np.array_equal(alone.poses_at([0]), alone.poses_at([scans[0].stamp_ns]))


def test_without_wheels_the_body_goes_on_for_a_step_beyond_the_first_scan_and_the_last():
    poses = [np.array((0.3 * k, 0.0, 0.1 * k)) for k in range(3)]
    steps = [Step(1_000_000_000 * k, pose, np.eye(3), np.eye(3)) for k, pose in enumerate(poses)]
    before, after = between_scans(steps, None)
    assert (before.stamp_ns, after.stamp_ns) == (-1_000_000_000, 3_000_000_000)
    middle = inverse(planar_transform(*poses[1]))
    for reading, end in ((before, planar_transform(*poses[0])), (after, planar_transform(*poses[2]))):
        assert reading.odom_T_body == pytest.approx(end @ middle @ end)
    assert between_scans(steps[:1], None) == []


def test_what_matched_scans_know_is_not_asked_of_the_planes():
    """Two lasers and no odometry in a corridor: its walls alone had moved the first keyframes back by 2.4 m."""
    truth = make_drive(Recipe.parse("people/paper/absent/none"), 900001)
    log = until(truth.log, truth.log.scans()[0].stamp_ns + 12_000_000_000)
    run = run_slam(log, truth.rig, SlamConfig())
    errors = drive_errors(run, truth)
    assert len(errors) > 8 and np.abs(errors[:, :2, 3]).max() < 0.02
    start, end = truth.truth.poses_at([run.trajectory.stamps_ns[0], run.scan_trajectory.stamps_ns[-1]])
    last = inverse(start) @ end
    found = inverse(run.trajectory.poses[0]) @ run.scan_trajectory.poses[-1]
    assert np.linalg.norm((last - found)[:2, 3]) < 0.02


def test_a_level_laser_beside_a_push_broom_one_measures_the_motion_too():
    """By wheels alone, three times worse than stated, such drives were 0.2 and 1.6 m off."""
    run, off = mapped_beginning("hall/paper/worse3", 430002, 341)
    assert isinstance(made_track(run.log, run.rig, SlamConfig()), LaserTrack)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.03
    leaning = with_sensors(run.rig, mount=Mount(rpy_deg=(0.0, 10.0, 0.0)))
    assert not isinstance(made_track(run.log, leaning, SlamConfig()), LaserTrack)


def test_odometry_that_never_moves_is_as_good_as_none():
    """Believed until it is refuted, it hid the first metres of a corridor: 4.8 m, and the run called itself sound."""
    log = rooms(11).log
    still = [replace(e, odom_T_body=np.eye(4)) if isinstance(e, OdometryReading) else e for e in log.events]
    dead = replace(log, events=still)
    assert len(dead.odometry) == len(log.odometry) and not dead.measured_motion and log.measured_motion == log.odometry
    frames = [list(keyframes_of(one, stated(log), SlamConfig()))[1:] for one in (dead, scans_alone(log))]
    for one, other in zip(*frames, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.motion.a_T_b, other.motion.a_T_b)
        np.testing.assert_array_equal(one.motion.covariance, other.motion.covariance)
        assert not one.motion.is_measured


@pytest.mark.parametrize("wheels, sentence", [("still", "got one pose all along"), ("good", "found none")])
def test_a_push_broom_laser_alone_needs_odometry_that_moves(wheels: str, sentence: str):
    """With wheels that never moved all scans were one window, minutes of work for a heap of points."""
    drive = make_drive(Recipe.parse(f"hall/pushbroom/{wheels}"), 5)
    log = drive.log if wheels == "still" else scans_alone(drive.log)
    with pytest.raises(LogError, match=f"expected odometry beside the scans, {sentence}"):
        list(keyframes_of(log, drive.rig, SlamConfig()))


@pytest.mark.parametrize("name, seed", [("office/paper/worse3/half", 460002), ("people/paper/worse3/reversed", 430010)])
def test_wheels_worse_than_stated_are_not_taken_for_slipping_in_the_first_steps(name: str, seed: int):
    """They were, and the way along the corridor was told by the returns alone: 6 and 40 cm off at the first one."""
    given = make_drive(Recipe.parse(name), seed)
    stamps = [scan.stamp_ns for scan in given.log.scans() if isinstance(scan, LaserScan)]
    end = next(one for one in given.truth.stamps_ns if one >= stamps[0] + 3_000_000_000)
    log = until(given.log, end)
    track = made_track(log, given.rig, SlamConfig())
    scans = [scan.stamp_ns for scan in log.scans() if given.rig.sensors[scan.sensor].kind == "line"]
    found = inverse(track.poses_at(scans[:1])[0]) @ track.poses_at(scans)
    true = given.truth.poses_at(scans)
    off = np.linalg.inv(inverse(true[0]) @ true) @ found
    assert len(scans) > 5 and np.abs(off[:, :2, 3]).max() < 0.03
