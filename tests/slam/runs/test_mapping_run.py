"""`spplanes map` on logs that are not as they should be: a defined map, or one clear sentence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.errors import LogError
from slam.runs.mapping_run import run_map
from slam.sensors.log import LaserScan, Log
from slam.simulation import VERTICAL, Mission, simulate_mission


@pytest.fixture(scope="module")
def corridor() -> Mission:
    return simulate_mission("corridor", n_scans=40, seed=0)


def scans_of(mission: Mission) -> list[LaserScan]:
    return [scan for scan in mission.log.scans(VERTICAL) if isinstance(scan, LaserScan)]


def log_of(mission: Mission, scans: list[LaserScan]) -> Log:
    return replace(mission.log, events=list(scans))


def test_a_few_bad_scans_leave_the_large_planes_as_they_are(corridor: Mission):
    scans = scans_of(corridor)
    whole = run_map(log_of(corridor, scans), corridor.rig, SlamConfig())
    for bad in (np.nan, np.inf, 0.0, -1.0):
        ranges = np.full_like(scans[0].ranges, bad)
        some = [replace(scan, ranges=ranges) if k in (7, 20) else scan for k, scan in enumerate(scans)]
        result = run_map(log_of(corridor, some), corridor.rig, SlamConfig())
        assert result.n_points_represented > 0.95 * result.n_points_seen
        for normal in ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]):
            before, after = (
                max((one.plane for one in each.planes if one.plane.normal @ normal > 0.99), key=lambda p: p.n_points)
                for each in (whole, result)
            )
            assert after.n_points == pytest.approx(before.n_points * 38 / 40, rel=0.1)
            assert after.normal @ before.normal > np.cos(0.02)
        assert result.n_points_seen == sum(
            np.isfinite(scan.ranges).sum() for k, scan in enumerate(scans) if k not in (7, 20)
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
def test_no_return_at_all_is_an_empty_map(corridor: Mission, bad: float):
    scans = [replace(scan, ranges=np.full_like(scan.ranges, bad)) for scan in scans_of(corridor)]
    result = run_map(log_of(corridor, scans), corridor.rig, SlamConfig())
    assert (result.planes, result.n_points_seen, result.n_points_represented) == ([], 0, 0)


def test_scans_out_of_time_order_or_of_other_length_are_refused(corridor: Mission):
    scans = scans_of(corridor)
    with pytest.raises(LogError, match=r"expected scans of 'vertical' in time order, got \d+ ns after \d+ ns"):
        run_map(log_of(corridor, [*scans[:10], scans[11], scans[10], *scans[12:]]), corridor.rig, SlamConfig())
    short = replace(scans[5], ranges=scans[5].ranges[:-1], angles=scans[5].angles[:-1])
    with pytest.raises(LogError, match=r"expected 361 beams in every scan of 'vertical', got 360"):
        run_map(log_of(corridor, [*scans[:5], short, *scans[6:]]), corridor.rig, SlamConfig())
    with pytest.raises(LogError, match="got one without; use slam"):
        run_map(log_of(corridor, [*scans[:5], replace(scans[5], world_T_body=None)]), corridor.rig, SlamConfig())
