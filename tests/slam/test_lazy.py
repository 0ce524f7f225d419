"""Sequences that only grow, and what waits on the disk: read as it was written, copied as what is in memory."""

from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam import Keyframe, PlaneSlam
from slam.backend.marginalized_poses import PastPose, PastPoses
from slam.lazy import Rows
from slam.sensors.log import CloudScan, LaserScan, OdometryReading, StoredCloud, StoredReading, StoredScan
from slam.session.replay import StoredKeyframe
from tests.slam.scenes import drive, run_of


def test_rows_are_what_was_put_in():
    rows, wanted = Rows("idh"), [(0, 0.1, 2), (5, float("inf"), 3), (70_000, 5e-324, 6)]
    for row in wanted:
        rows.append(row)
    assert rows == wanted and list(rows) == wanted and rows[-1] == wanted[-1] and rows[1:] == wanted[1:]
    assert rows != wanted[:2] and type(rows[0][0]) is int and type(rows[0][1]) is float
    with pytest.raises(IndexError):
        rows[3]
    with pytest.raises(TypeError, match="item assignment"):
        rows[0] = (1, 1.0, 1)  # type: ignore[index]


def test_past_poses_come_back_bit_for_bit():
    rng, past, made = np.random.default_rng(0), PastPoses(), {}
    for number in (3, 0, 600, 599):
        joint, base = rng.normal(size=(12, 12)), gtsam.symbol("x", number + 1)
        poses = [gtsam.Pose3.Expmap(rng.normal(size=6)).matrix() for _ in range(2)]
        made[gtsam.symbol("x", number)] = PastPose.of(base, *poses, joint @ joint.T)  # type: ignore[call-arg]
    for key, one in made.items():
        past.add(key, one)
    assert len(past) == 4 and gtsam.symbol("x", 1) not in past and gtsam.symbol("x", 10**6) not in past
    assert gtsam.symbol("p", 3) not in past
    for key, one in made.items():
        assert key in past
        for name, wanted in vars(one).items():
            np.testing.assert_array_equal(getattr(past.at(key), name), wanted)


@pytest.mark.parametrize("read_only", [False, True])
def test_what_was_forgotten_is_what_was_kept(tmp_path: Path, read_only: bool):
    frames, path = drive(0).keyframes[:8], tmp_path / "session.db"
    kept = run_of(frames)
    with PlaneSlam.open(path, forget_raw=True) as slam:
        run_of(frames, slam)
        if not read_only:
            _compare(slam, kept)
    with PlaneSlam.open(path, read_only=read_only, forget_raw=True) as slam:
        _compare(slam, kept)


def _compare(slam: PlaneSlam, kept: PlaneSlam) -> None:
    assert np.array_equal(slam.trajectory.poses, kept.trajectory.poses)
    assert slam.decisions == kept.decisions and slam.decisions[-1] == kept.decisions[-1]
    assert slam.audit.history == kept.audit.history
    for index, (one, other) in enumerate(zip(slam.keyframes, kept.keyframes, strict=True)):
        assert one.stamp_ns == other.stamp_ns and len(one.observations) == len(other.observations)
        assert (one.motion is None) == (other.motion is None) and (one.returns is None) == (other.returns is None)
        if one.motion is not None and other.motion is not None:
            assert np.array_equal(one.motion.a_T_b, other.motion.a_T_b)
        assert slam.explain(index) == kept.explain(index)


def test_a_copy_of_what_waits_on_the_disk_is_in_memory():
    known, ranges = {"stamp_ns": 1, "sensor": "laser", "angles": np.zeros(3)}, {"ranges": partial(np.full, 3)}
    scan = replace(StoredScan(known, ranges, 7), stamp_ns=2)
    assert type(scan) is LaserScan and scan.stamp_ns == 2 and scan.ranges.tolist() == [7.0] * 3
    assert scan.world_T_body is None and scan.sensor == "laser"
    reading = replace(StoredReading({"stamp_ns": 1}, {"odom_T_body": lambda place: place * np.eye(4)}, 7), stamp_ns=2)
    assert type(reading) is OdometryReading and reading.stamp_ns == 2 and reading.odom_T_body[0, 0] == 7.0
    stored_cloud = StoredCloud({"stamp_ns": 1, "sensor": "laser"}, {"points": lambda _: np.ones((4, 3))})
    cloud = replace(stored_cloud, sensor="other")
    assert type(cloud) is CloudScan and cloud.sensor == "other" and cloud.points.shape == (4, 3)
    whole = replace(drive(0, count=2).keyframes[1], surfaces=np.ones((2, 9)), notes=("dusty",))
    readers = {one.name: partial(lambda name, _: getattr(whole, name), one.name) for one in fields(Keyframe)}
    stored = StoredKeyframe({"stamp_ns": whole.stamp_ns}, readers)
    assert stored.notes == ("dusty",) and repr(stored) == f"StoredKeyframe(stamp_ns={whole.stamp_ns})"
    frame = replace(stored, notes=("late",))
    assert type(frame) is Keyframe and frame.motion is whole.motion and frame.notes == ("late",)
    assert frame.surfaces is whole.surfaces and list(frame.observations) == list(whole.observations)
