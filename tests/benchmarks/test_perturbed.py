"""Real logs made worse: by as much as is said, and by nothing else."""

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.corpus.catalogue import PERTURBED, Entry, corpus
from benchmarks.corpus.perturbed import PERTURBATIONS
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.io.default_rigs import default_rig_for
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS as NOISE


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """300 m in steps of 10 cm, each with a turn of a tenth of a radian to either side, and a scan at every step."""
    events, pose = [], np.eye(4)
    for k in range(3000):
        pose, ranges = pose @ planar_transform(0.1, 0.0, 0.1 * (-1) ** k), np.full(180, 3.0)
        events.append(OdometryReading(100_000_000 * k, pose))
        events.append(LaserScan(100_000_000 * k, "FLASER", ranges, np.linspace(-1.5, 1.5, 180)))
    return Log(events, tmp_path_factory.mktemp("log") / "made.clf")


def worse(log: Log, kind: str, seed: int = 1) -> Log:
    return PERTURBATIONS[kind](log, default_rig_for(log), np.random.default_rng(seed))


def turns_of(log: Log) -> np.ndarray:
    return np.array([planar_delta(inverse(a.odom_T_body) @ b.odom_T_body)[2] for a, b in pairwise(log.odometry)])


def test_headings_err_three_times_as_much_as_stated_together_with_what_they_err_anyway(log):
    added = turns_of(worse(log, "heading3")) - turns_of(log)
    stated = NOISE.heading_sigma_rad_per_sqrt_m**2 * 0.1 + NOISE.heading_sigma_rad_per_sqrt_rad**2 * 0.1
    assert np.var(added) / stated == pytest.approx(8.0, rel=5.0 * np.sqrt(2.0 / len(added)))
    assert abs(added.mean()) < 4.0 * np.sqrt(8.0 * stated / len(added))


def test_one_slip_in_a_hundred_metres(log):
    added = turns_of(worse(log, "slips")) - turns_of(log)
    slips = np.flatnonzero(np.abs(added) > 1e-9)
    assert 2 <= len(slips) <= 3 and np.abs(np.rad2deg(added[slips])) == pytest.approx(20.0)
    assert all(slip // 1000 == number for number, slip in enumerate(slips.tolist()))


def test_ranges_scatter_twice_as_much_as_stated_together_with_what_they_scatter_anyway(log):
    ranges = np.concatenate([scan.ranges for scan in worse(log, "noise2").scans()])
    stated = default_rig_for(log).sensors["FLASER"].range_sigma_m
    assert np.std(ranges - 3.0) == pytest.approx(np.sqrt(3.0) * stated, rel=0.02)


def test_every_second_scan_and_all_of_the_odometry(log):
    left = worse(log, "half")
    assert len(left.scans()) == 1500 and len(left.odometry) == 3000


def test_stamps_of_the_odometry_are_moved_and_the_log_stays_in_order(log):
    moved = worse(log, "late")
    shift = {b.stamp_ns - a.stamp_ns for a, b in zip(log.odometry, moved.odometry, strict=True)}
    assert shift in ({100_000_000}, {-100_000_000})
    stamps = [event.stamp_ns for event in moved.events]
    assert stamps == sorted(stamps) and len(stamps) == 6000


def test_the_seed_says_which_and_logs_made_worse_are_there_by_name_alone(log):
    a, b, c = (turns_of(worse(log, "slips", seed)) for seed in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert corpus([3, 4], kinds=["real/aces/slips"]) == [Entry("real/aces/slips", 3), Entry("real/aces/slips", 4)]
    assert not {entry.name for entry in corpus([0])} & set(PERTURBED)
    assert len(corpus([0], kinds=["real/intel/*"])) == len(PERTURBATIONS)
