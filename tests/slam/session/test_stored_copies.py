"""What waits on the disk is copied with another value as what is in memory is."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from slam.frontend.keyframes import Keyframe
from slam.io.spool import StoredReading, StoredScan
from slam.sensors.log import CloudScan, LaserScan, OdometryReading, StoredCloud
from slam.session.forgetting import StoredKeyframe
from tests.slam.scenes import drive


def test_a_copy_of_what_waits_on_the_disk_is_in_memory():
    scan = replace(StoredScan(1, "laser", np.zeros(3), 7, lambda place: np.full(3, place)), stamp_ns=2)
    assert type(scan) is LaserScan and scan.stamp_ns == 2 and scan.ranges.tolist() == [7.0] * 3
    assert scan.world_T_body is None and scan.sensor == "laser"
    reading = replace(StoredReading(1, 7, lambda place: place * np.eye(4)), stamp_ns=2)
    assert type(reading) is OdometryReading and reading.stamp_ns == 2 and reading.odom_T_body[0, 0] == 7.0
    cloud = replace(StoredCloud(1, "laser", partial(np.ones, (4, 3))), sensor="other")
    assert type(cloud) is CloudScan and cloud.sensor == "other" and cloud.points.shape == (4, 3)
    whole = replace(drive(0, count=2).keyframes[1], surfaces=np.ones((2, 8)))
    notes = ("dusty",), ("slipped",)
    stored = StoredKeyframe(whole.stamp_ns, len(whole.observations), notes, lambda: whole, (1, 0, 0, 1))
    assert (stored.notes, stored.motion_notes) == notes
    frame = replace(stored, notes=("late",))
    assert type(frame) is Keyframe and frame.motion is whole.motion
    assert (frame.notes, frame.motion_notes) == (("late",), ("slipped",))
    assert frame.surfaces is whole.surfaces
    assert list(frame.observations) == list(whole.observations)
