"""Odometry that begins anew, or is set to another place: the body went on as before, as surely as it does so."""

from itertools import accumulate

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from factors._conventions import POSE3_TO_SP
from slam.config import SlamConfig
from slam.frontend.odometry import Motion, OdometryTrack, planar_delta
from slam.geometry.frames import inverse
from slam.runs.slam_run import run_slam
from slam.sensors.log import OdometryReading
from spplanes._check import FloatArray
from tests.slam.scenes import SURE_WHEELS
from tests.slam.short_drives import errors_of, until, with_jump
from tests.statistics import assert_mean_in_band

TICK_NS, AT = 50_000_000, 40
#: Usual twist of a step, GTSAM order, and how much steps differ from it, on the floor and in space.
STEP = (0.0, 0.0, 0.02, 0.05, 0.0, 0.0)
CHANGES = {"floor": (0.0, 0.0, 0.01, 0.004, 0.002, 0.0), "space": (0.003, 0.006, 0.01, 0.004, 0.002, 0.001)}
JUMPS = {"ahead": (0.0, 0.0, 0.0, 2.0, 0.0, 0.0), "turned": (0.0, 0.0, 2.0, 0.0, 0.0, 0.0), "anew": None}


def driven(rng: np.random.Generator, kind: str, n_steps: int = 80) -> FloatArray:
    """Poses (N, 4, 4) of a body whose steps differ a little, each by itself."""
    twists = np.array(STEP) + np.array(CHANGES[kind]) * rng.standard_normal((n_steps, 6))
    steps = (gtsam.Pose3.Expmap(twist).matrix() for twist in twists)
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(4))))


def jump_at(there: FloatArray, jump: tuple[float, ...] | None) -> FloatArray:
    """By what poses of the odometry are off after a jump to a pose; None: it begins anew there."""
    return inverse(there) if jump is None else there @ gtsam.Pose3.Expmap(np.array(jump)).matrix() @ inverse(there)


def jumped(poses: FloatArray, jump: tuple[float, ...] | None, at: int = AT) -> FloatArray:
    """The same as odometry says it that jumps after a pose."""
    return np.concatenate((poses[: at + 1], jump_at(poses[at + 1], jump) @ poses[at + 1 :]))


def track_of(poses: FloatArray, stamps_ns: np.ndarray | None = None) -> OdometryTrack:
    """By wheels that nothing but a jump makes err."""
    stamps = np.arange(len(poses)) * TICK_NS if stamps_ns is None else stamps_ns
    return OdometryTrack([OdometryReading(int(t), pose) for t, pose in zip(stamps, poses, strict=True)], SURE_WHEELS)


def nees(motion: Motion, true: FloatArray) -> float:
    """Of a motion against the true one, (x, y, heading) on the floor and 6 degrees of freedom in space."""
    if motion.is_planar:
        off = planar_delta(true) - planar_delta(motion.a_T_b)
    else:
        off = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(motion.a_T_b) @ true))[POSE3_TO_SP]
    return float(off @ np.linalg.solve(motion.covariance, off))


@pytest.mark.parametrize("kind", CHANGES)
@pytest.mark.parametrize("jump", JUMPS)
def test_a_motion_over_a_jump_is_as_sure_as_it_says(kind: str, jump: str) -> None:
    """Steps differ by two independent changes: what one of them leaves of a step once more is told by the others."""
    rng, at_once, later = np.random.default_rng(1), [], []
    for _ in range(150):  # a tenth more or less of the sigmas is off the band
        true = driven(rng, kind)
        track = track_of(jumped(true, JUMPS[jump]))
        assert track.jumps_ns == [(AT + 1) * TICK_NS]
        for end, into in ((AT + 1, at_once), (AT + 25, later)):
            motion = track.motion((AT - 3) * TICK_NS, end * TICK_NS)
            assert motion.is_planar == (kind == "floor")
            into.append(nees(motion, inverse(true[AT - 3]) @ true[end]))
        before = track.motion(0, AT * TICK_NS)
        np.testing.assert_allclose(before.a_T_b, true[AT], atol=1e-9)
        assert np.sqrt(np.diag(before.covariance)).max() < 1e-4  # only motions over it are unsure
    for values in (at_once, later):
        assert_mean_in_band(np.array(values), 3 if kind == "floor" else 6)


def test_every_jump_is_found_the_first_step_too() -> None:
    true, at = driven(np.random.default_rng(2), "space", 500), (0, 20, 30, 499)
    odometry = true
    for one in at:
        odometry = jumped(odometry, (0.0, 0.0, 0.0, 0.0, -1.5, 0.0), one)
    track = track_of(odometry)
    assert track.jumps_ns == [(one + 1) * TICK_NS for one in at]
    for one in at:
        motion = track.motion(one * TICK_NS, (one + 1) * TICK_NS)
        assert nees(motion, inverse(true[one]) @ true[one + 1]) < 22.5


def test_what_robots_do_is_no_jump() -> None:
    """They stand for long, start, stop, and turn on the spot; readings are missing; two are at nearly one time."""
    twists = np.array(((0.0, 0.0, 0.02, 0.1, 0.0, 0.0), (0.0, 0.0, 0.3, 0.0, 0.0, 0.0)))
    step, spin = (gtsam.Pose3.Expmap(twist).matrix() for twist in twists)
    steps = [np.eye(4)] * 3000 + [step] * 12 + [np.eye(4)] * 5 + [spin] * 3 + [step] * 5
    poses = np.array(list(accumulate(steps, np.matmul)))
    stamps = np.arange(len(poses)) * TICK_NS
    late, heard = stamps.copy(), np.delete(np.arange(len(poses)), np.arange(3003, 3008))
    late[3005] = late[3004] + 1
    for few, times in ((poses, stamps), (poses, late), (poses[heard], stamps[heard]), (poses[:60], stamps[:60])):
        assert not track_of(few, times).jumps_ns
    assert not track_of(jumped(poses[3000:3012], JUMPS["ahead"], 5)).jumps_ns  # of so few steps nobody can tell


@pytest.mark.parametrize("jump", JUMPS)
def test_a_push_broom_robot_is_where_it_would_be_without(jump: str) -> None:
    """Nothing but wheels places one slice beside another: it was 1.5 to 10 m off, and the run was called sound."""
    drive = make_drive(Recipe.parse("office/pushbroom/good"), 8801)
    stamps = [scan.stamp_ns for scan in drive.log.scans()]
    log, after_ns = until(drive.log, stamps[len(stamps) // 3]), stamps[len(stamps) // 5]
    at = next(reading for reading in log.odometry if reading.stamp_ns > after_ns)
    run = run_slam(with_jump(log, at.stamp_ns, jump_at(at.odom_T_body, JUMPS[jump])), drive.rig, SlamConfig())
    assert np.linalg.norm(errors_of(run, drive)[:, :3, 3], axis=1).max() < 0.05
    assert sum("odometry jumps at" in note for note in run.log.notes) == 1
