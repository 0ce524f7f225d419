"""A wrong mount is named also where the returns refuted the odometry that it made look wrong."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.config import SlamConfig
from slam.diagnostics.evidence.mounts import heading_evidence
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Mount, Rig, Sensor


@pytest.mark.parametrize(
    "name, seed", [("office/level/good/backwards", 94001), ("glass/level/biased/backwards", 94003)]
)
def test_a_laser_mounted_backwards_is_named_though_its_scans_fit_each_other(name: str, seed: int) -> None:
    drive = make_drive(Recipe.parse(name), seed)
    verdict = run_slam(drive.log, drive.rig, SlamConfig()).verdict
    assert verdict.verdict == "broken"
    assert any("mounted backwards" in reason for reason in verdict.reasons)


def along(steps: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a body that goes so far along its x at every step."""
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps)
    return poses


def frames(count: int, motion: Motion | None = None) -> list[Keyframe]:
    return [Keyframe(k, [], motion if k else None) for k in range(count)]


def test_a_body_that_goes_backwards_all_along_is_doubted_where_nobody_measured_it() -> None:
    mount = Mount(xyz_m=(0.1, 0.0, 0.5))
    rig = Rig(sensors={"lidar": Sensor(kind="cloud", body_T_sensor=mount, range_sigma_m=0.01, range_max_m=30.0)})
    unknown = rig.model_copy(update={"sensors": {"lidar": rig.sensors["lidar"].model_copy(update={"mount": Mount()})}})
    back, ahead = along(np.full(30, -0.4)), along(np.full(30, 0.4))
    [found] = heading_evidence(frames(31), back, rig)
    assert found.grade == "doubtful" and found.p_value < 1e-6 and "mounted backwards" in found.sentence
    assert found.size == pytest.approx(1.0) and found.keyframes == tuple(range(1, 31))
    there_and_back = along(np.concatenate((np.full(15, 0.4), np.full(15, -0.4))))
    measured = Motion(np.eye(4), np.eye(3), (0.1, 0.1, 0.1))
    for poses, some, sensors in (
        (ahead, frames(31), rig),
        (there_and_back, frames(31), rig),
        (back, frames(31, measured), rig),
        (back, frames(31), unknown),
        (back[:5], frames(5), rig),
        (back[:1], frames(1), rig),
    ):
        assert not list(heading_evidence(some, poses, sensors))
    sideways = back.copy()
    sideways[:, 1, 3] = 5.0 * sideways[:, 0, 3]
    assert not list(heading_evidence(frames(31), sideways, rig))
