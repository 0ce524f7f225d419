"""README's "Your own data, in ten minutes" on real data: bags of sensors and nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.io.load import load
from slam.sensors.log import CloudScan, LaserScan
from tests.slam.commands import run
from tests.slam.io.bags import Messages, write
from tests.slam.real_data import needs

#: What a bag holds: topic, time of recording and message.
Record = tuple[str, int, Any]


def lidar_bag(messages: Messages, n_clouds: int) -> Iterator[Record]:
    """Clouds of a hall, their returns in no order, and nothing else."""
    rng = np.random.default_rng(1)
    for scan in load(needs("balm_hall/000.pcd").parent)[0].scans()[:n_clouds]:
        assert isinstance(scan, CloudScan)
        points = scan.points.reshape(-1, 3)
        points = rng.permutation(points[np.isfinite(points).all(axis=1)])
        yield "/os/points", scan.stamp_ns, messages.cloud(scan.stamp_ns, points, "os_lidar")


def laser_bag(messages: Messages, path: Path, n_scans: int) -> Iterator[Record]:
    """Scans of a laser on a robot."""
    for scan in load(path)[0].scans()[:n_scans]:
        assert isinstance(scan, LaserScan)
        beams = {
            "angle_min": scan.angles[0],
            "angle_max": scan.angles[-1],
            "angle_increment": (scan.angles[-1] - scan.angles[0]) / (len(scan.angles) - 1),
            "time_increment": 0.0,
            "range_max": 50.0,
        }
        ranges = np.where(np.isfinite(scan.ranges), scan.ranges, np.inf)
        yield "/scan", scan.stamp_ns, messages.scan(scan.stamp_ns, ranges, **beams)


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
    """The hall's LiDAR odometry, poses one second apart as the clouds of a folder without stamps."""
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


def test_a_bag_of_a_laser_without_odometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = needs("intel/intel_full.clf.gz")
    bag = write(tmp_path, "mcap", lambda messages: laser_bag(messages, path, 400))
    _, printed = mapped(capsys, bag, tmp_path / "run")
    assert "assumed: no odometry" in printed
    figures = off_by(capsys, tmp_path / "run", needs("intel/intel.relations.gz"))
    assert figures["relations found"] >= 10 and figures["relations translation mean"] < 0.03
    assert figures["relations rotation mean"] < 0.4
