"""What no working sensor says: distances in another unit, one scan over and over, two scans at one time."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.errors import LogError
from slam.geometry.frames import planar_transform
from slam.io.default_rigs import cloud_rig
from slam.io.plausibility import plausible
from slam.runs.slam_run import run_slam
from slam.sensors.log import CloudScan, Event, LaserScan, Log, OdometryReading, StoredCloud
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray

RIG = Rig(sensors={"front": Sensor(kind="line", range_sigma_m=0.01, range_max_m=30.0)})
ANGLES = np.linspace(-1.5, 1.5, 90)
PERIOD_NS = 200_000_000


def scan(index: int, ranges: FloatArray | None = None) -> LaserScan:
    """The scan of an index, five a second, of a room that looks otherwise each time."""
    seen = np.random.default_rng(index).uniform(2.0, 4.0, len(ANGLES)) if ranges is None else ranges
    return LaserScan(index * PERIOD_NS, "front", seen.copy(), ANGLES)


def driven(scans: list[LaserScan], step_m: float) -> Log:
    """A log of scans, so far apart by the wheels."""
    events: list[Event] = []
    for k, one in enumerate(scans):
        events += [OdometryReading(one.stamp_ns, planar_transform(step_m * k, 0.0, 0.0)), one]
    return Log(events, Path("drive.clf"))


def kept(log: Log) -> list[int]:
    return [one.stamp_ns // PERIOD_NS for one in plausible(log, RIG).scans()]


def hanging(last: int = 9) -> list[LaserScan]:
    """Twelve scans, the one of an index and those before it as the fourth."""
    fourth = scan(3).ranges
    return [scan(k, fourth if 3 <= k <= last else None) for k in range(12)]


def test_a_laser_that_hangs_while_the_wheels_move_says_nothing():
    log = driven(hanging(), 0.03)
    assert kept(log) == [0, 1, 2, 3, 4, 10, 11]  # at the fifth they have come 3 cm: it may stand
    assert "sensor 'front' repeats itself while the wheels move, 5 times between 1.000 and 1.800 s" in log.notes[0]


@pytest.mark.parametrize(
    "log", [driven(hanging(), 0.001), driven(hanging(8), 0.03), Log(list(hanging()), Path("drive.clf"))]
)
def test_who_stands_or_has_no_wheels_may_see_the_same_again_and_a_moment_tells_nothing(log: Log):
    assert kept(log) == list(range(12)) and not log.notes


def test_scans_at_one_time_are_told_of_and_a_log_of_one_time_is_refused():
    log = driven([scan(0), scan(1), scan(1, scan(7).ranges), scan(2)], 0.1)
    assert len(plausible(log, RIG).scans()) == 4
    assert log.notes == ["1 of 4 scans of 'front' have the time of the one before: of each time one is used"]
    with pytest.raises(LogError, match="all 12 scans of 'front' have one time: expected times that grow"):
        plausible(driven([scan(1)] * 12, 0.1), RIG)


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_lasers_in_another_unit_are_refused_and_glitches_are_not(unit: float):
    scans = [scan(k, unit * scan(k).ranges) for k in range(9)]
    with pytest.raises(LogError, match=r"more than .* m away: expected metres"):
        plausible(driven(scans, 0.1), RIG)
    assert kept(driven([*scans[:1], *(scan(k) for k in range(1, 9))], 0.1)) == list(range(9))


def clouds(*points: FloatArray | None) -> Log:
    """A log of clouds; None: one that cannot be read."""

    def read_nothing(_: int) -> FloatArray:
        raise LogError("scan.pcd", "expected points, found none")

    events: list[Event] = [
        StoredCloud({"stamp_ns": k, "sensor": "cloud"}, {"points": read_nothing})
        if one is None
        else CloudScan(k, "cloud", one)
        for k, one in enumerate(points)
    ]
    return Log(events, Path("clouds"))


def test_clouds_in_another_unit_are_refused():
    room = np.random.default_rng(0).uniform(-4.0, 4.0, (500, 3))
    plausible(clouds(room), cloud_rig())
    for far in (1000.0 * room, np.add(room, (500e3, 4.5e6, 0.0))):
        with pytest.raises(LogError, match=r"millimetres, or coordinates on a map\?"):
            plausible(clouds(far, far), cloud_rig())


def test_clouds_of_which_none_can_be_read_are_refused():
    with pytest.raises(LogError, match=r"scan\.pcd: expected points, found none"):
        plausible(clouds(*[None] * 9), cloud_rig())
    one = [None] * 8 + [np.random.default_rng(0).uniform(-4.0, 4.0, (500, 3))]
    assert len(plausible(clouds(*one), cloud_rig()).scans()) == 9


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda events: events[::-1], "order of their times"),
        (lambda events: [*events, OdometryReading(10**12, np.full((4, 4), np.nan))], "1000.000 s: expected odometry"),
        (lambda events: [*events, OdometryReading(10**12, np.eye(3))], r"got shape \(3, 3\)"),
        (lambda events: [*events, LaserScan(10**12, "L", np.ones(540), np.ones(541))], "expected a 2D scan's"),
        (lambda events: [*events, LaserScan(10**12, "L", [1.0], [0.0])], "expected a 2D scan's"),  # type: ignore
    ],
)
def test_logs_made_by_hand_are_refused_where_an_event_is_amiss(spoil: Callable[[list], list], said: str):
    log = driven([scan(index) for index in range(4)], 0.1)
    spoilt = replace(log, events=spoil(log.events))
    with pytest.raises(LogError, match=said):
        run_slam(spoilt, RIG, SlamConfig())
