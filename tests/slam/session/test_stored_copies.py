"""What waits on the disk is copied with another value as what is in memory is."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import numpy as np

from slam.frontend.keyframes import Keyframe
from slam.sensors.log import CloudScan, LaserScan, OdometryReading, StoredCloud, StoredReading, StoredScan
from slam.session.replay import StoredKeyframe
from tests.slam.scenes import drive


def test_a_copy_of_what_waits_on_the_disk_is_in_memory():
    known, ranges = {"stamp_ns": 1, "sensor": "laser", "angles": np.zeros(3)}, {"ranges": partial(np.full, 3)}
    scan = replace(StoredScan(known, ranges, 7), stamp_ns=2)
    assert type(scan) is LaserScan and scan.stamp_ns == 2 and scan.ranges.tolist() == [7.0] * 3
    assert scan.world_T_body is None and scan.sensor == "laser"
    reading = replace(StoredReading({"stamp_ns": 1}, {"odom_T_body": lambda place: place * np.eye(4)}, 7), stamp_ns=2)
    assert type(reading) is OdometryReading and reading.stamp_ns == 2 and reading.odom_T_body[0, 0] == 7.0
    cloud = replace(StoredCloud(1, "laser", partial(np.ones, (4, 3))), sensor="other")
    assert type(cloud) is CloudScan and cloud.sensor == "other" and cloud.points.shape == (4, 3)
    whole = replace(drive(0, count=2).keyframes[1], surfaces=np.ones((2, 8)))
    whole = replace(whole, notes=("dusty",), motion_notes=("slipped",))
    readers = {one.name: partial(lambda name, _: getattr(whole, name), one.name) for one in fields(Keyframe)}
    stored = StoredKeyframe({"stamp_ns": whole.stamp_ns}, readers)
    assert (stored.notes, stored.motion_notes) == (("dusty",), ("slipped",))
    assert repr(stored) == f"StoredKeyframe(stamp_ns={whole.stamp_ns})"
    frame = replace(stored, notes=("late",))
    assert type(frame) is Keyframe and frame.motion is whole.motion
    assert (frame.notes, frame.motion_notes) == (("late",), ("slipped",))
    assert frame.surfaces is whole.surfaces
    assert list(frame.observations) == list(whole.observations)
