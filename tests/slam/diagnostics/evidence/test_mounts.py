"""A wrong mount is named also where the returns refuted the odometry that it made look wrong."""

from __future__ import annotations

import pytest

from slam.config import SlamConfig
from slam.runs.slam_run import run_slam
from slam.simulation.drives import Recipe, make_drive


@pytest.mark.parametrize(
    "name, seed", [("office/level/good/backwards", 94001), ("glass/level/biased/backwards", 94003)]
)
def test_a_laser_mounted_backwards_is_named_though_its_scans_fit_each_other(name: str, seed: int) -> None:
    drive = make_drive(Recipe.parse(name), seed)
    verdict = run_slam(drive.log, drive.rig, SlamConfig()).verdict
    assert verdict.verdict == "broken"
    assert any("mounted backwards" in reason for reason in verdict.reasons)
