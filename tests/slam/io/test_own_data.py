"""README's "Your own data, in ten minutes" on real data: bags without odometry and with tf only, unordered clouds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.io.load import load
from slam.sensors.log import CloudScan, LaserScan, Log, OdometryReading
from spplanes._check import FloatArray
from tests.slam.commands import run
from tests.slam.io.bags import SECOND, Messages, write
from tests.slam.real_data import needs

#: What a bag holds: topic, time of recording and message.
Record = tuple[str, int, Any]


def clouds(log: Log, n_scans: int) -> Iterator[CloudScan]:
    """The first clouds of a log."""
    return islice((scan for scan in log.scans() if isinstance(scan, CloudScan)), n_scans)


def points_of(scan: CloudScan) -> FloatArray:
    """Returns of a cloud in no order, shape (N, 3)."""
    points = scan.points.reshape(-1, 3)
    return np.random.default_rng(1).permutation(points[np.isfinite(points).all(axis=1)])


def lidar_bag(messages: Messages, n_clouds: int) -> Iterator[Record]:
    """Clouds of a hall and nothing else."""
    for scan in clouds(load(needs("balm_hall/000.pcd").parent)[0], n_clouds):
        yield "/os/points", scan.stamp_ns, messages.cloud(scan.stamp_ns, points_of(scan), "os_lidar")


def laser_bag(messages: Messages, path: Path, n_scans: int, wheels: bool) -> Iterator[Record]:
    """Scans of a laser on a robot, whose wheels only tf tells of, or nothing."""
    log, rig = load(path)
    end = log.scans()[:n_scans][-1].stamp_ns
    (sensor,) = rig.sensors.values()
    if wheels:
        yield "/tf_static", SECOND, messages.tf("base_link", "laser", sensor.body_T_sensor)
    for event in log.events:
        if event.stamp_ns > end:
            return
        if isinstance(event, OdometryReading) and wheels:
            yield "/tf", event.stamp_ns, messages.tf("odom", "base_link", event.odom_T_body, event.stamp_ns)
        if not isinstance(event, LaserScan):
            continue
        angles = {"angle_min": event.angles[0], "angle_max": event.angles[-1]}
        beams = {
            "angle_increment": (event.angles[-1] - event.angles[0]) / (len(event.angles) - 1),
            "time_increment": 0.0,
            "range_max": 50.0,
        }
        ranges = np.where(np.isfinite(event.ranges), event.ranges, np.inf)
        yield "/scan", event.stamp_ns, messages.scan(event.stamp_ns, ranges, **angles, **beams)


def mapped(capsys: pytest.CaptureFixture[str], log: Path, folder: Path) -> tuple[dict[str, Any], str]:
    """`spplanes slam LOG --out RUN` and `spplanes view RUN`, as README has them: metrics and what was printed."""
    code, out, err = run(capsys, "slam", log, "--out", folder)
    assert code == 0, err
    assert run(capsys, "view", folder)[0] == 0
    assert {"plan.png", "side.png", "uncertainty.png", "report.html", "rig.yaml"} <= {x.name for x in folder.iterdir()}
    return json.loads((folder / "metrics.json").read_text()), out + err


def off_by(capsys: pytest.CaptureFixture[str], folder: Path, truth: Path) -> dict[str, float]:
    """Every figure that `spplanes evaluate` prints, by its name."""
    code, out, err = run(capsys, "evaluate", folder, "--truth", truth)
    assert code == 0, err
    rows = re.findall(r"│ (.+?) +│ +([-0-9.e]+) │", out)
    return {name.strip(): float(value) for name, value in rows}


def by_index(folder: Path, n_poses: int) -> Path:
    """The hall's LiDAR odometry with clouds one second apart, as a folder of clouds without stamps is read."""
    rows = needs("balm_hall/lidar_odometry.tum").read_text().splitlines()
    poses = [row.split()[1:] for row in rows if row and not row.startswith("#")]
    path = folder / "reference.tum"
    path.write_text("".join(f"{k} {' '.join(pose)}\n" for k, pose in enumerate(poses[:n_poses])))
    return path


def test_a_bag_of_a_lidar_without_odometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write(tmp_path, "ros1", lambda messages: lidar_bag(messages, 3))
    metrics, printed = mapped(capsys, bag, tmp_path / "run")
    assert "assumed: no odometry" in printed and "assumed: no rig" in printed
    assert metrics["verdict"]["verdict"] == "sound"
    figures = off_by(capsys, tmp_path / "run", by_index(tmp_path, 3))
    assert figures["ATE from the first pose, translation max"] < 0.03


@pytest.mark.parametrize(
    "log, kind, n_scans, wheels, said, n_relations, mean_m, mean_deg",
    [
        ("intel.clf.gz", "sqlite3", 150, True, "no Odometry: took tf from odom to base_link", 5, 0.04, 0.6),
        ("intel_full.clf.gz", "mcap", 400, False, "assumed: no odometry", 10, 0.03, 0.4),
    ],
    ids=["wheels in tf", "scans and nothing else"],
)
def test_a_bag_of_a_laser(
    log: str,
    kind: str,
    n_scans: int,
    wheels: bool,
    said: str,
    n_relations: int,
    mean_m: float,
    mean_deg: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = needs(f"intel/{log}")
    bag = write(tmp_path, kind, lambda messages: laser_bag(messages, path, n_scans, wheels))
    _, printed = mapped(capsys, bag, tmp_path / "run")
    assert said in printed
    figures = off_by(capsys, tmp_path / "run", needs("intel/intel.relations.gz"))
    assert figures["relations found"] >= n_relations and figures["relations translation mean"] < mean_m
    assert figures["relations rotation mean"] < mean_deg


def test_a_folder_of_unordered_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scans").mkdir()
    for k, scan in enumerate(clouds(load(needs("balm_hall/000.pcd").parent)[0], 3)):
        np.savetxt(tmp_path / "scans" / f"{k:03}.xyz", points_of(scan), fmt="%.4f")
    metrics, printed = mapped(capsys, tmp_path / "scans", tmp_path / "run")
    assert "assumed: no odometry" in printed
    assert metrics["verdict"]["verdict"] == "sound"
    figures = off_by(capsys, tmp_path / "run", by_index(tmp_path, 3))
    assert figures["ATE from the first pose, translation max"] < 0.03
