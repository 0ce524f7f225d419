"""`spplanes map` on logs that are not as they should be, and the points of a map that a page shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.errors import LogError
from slam.geometry.frames import planar_transform
from slam.io.trajectories import Trajectory
from slam.output.run_files import MOST_POINTS, points_of_map
from slam.runs.history import History
from slam.runs.mapping_run import run_map
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.sensors.rig import Mount, Rig, Sensor
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
        good = [scan for k, scan in enumerate(scans) if k not in (7, 20)]
        assert result.n_points_seen == sum(np.isfinite(scan.ranges).sum() for scan in good)


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


#: A laser half a metre ahead of the body that looks to its left.
MOUNTED = Mount(xyz_m=(0.5, 0.0, 0.2), rpy_deg=(0.0, 0.0, 90.0))
SECOND = 1_000_000_000


def rig(kind: str, mount: Mount = MOUNTED) -> Rig:
    sensor = Sensor(kind=kind, body_T_sensor=mount, range_sigma_m=0.01, range_min_m=0.3, range_max_m=20.0)
    return Rig(sensors={"eye": sensor})


def test_a_beam_is_where_the_laser_met_the_wall():
    scan = LaserScan(SECOND, "eye", np.array([2.0, 30.0, np.nan, 0.1]), np.array([0.0, 0.1, 0.2, 0.3]))
    other = LaserScan(SECOND, "nobody", np.array([5.0]), np.array([0.0]))
    late = replace(scan, stamp_ns=5 * SECOND)  # no pose is known of it
    log = Log([scan, other, late], Path("log"))
    poses = Trajectory(np.array([SECOND]), planar_transform(1.0, 1.0, np.pi / 2.0)[None])
    # ahead of the laser is left of the body is -x of the world; half a metre ahead of the body is +y
    np.testing.assert_allclose(points_of_map(log, rig("line"), poses), [[-1.0, 1.5, 0.2]], atol=1e-12)


def test_clouds_are_thinned_evenly_and_the_same_each_time():
    rng = np.random.default_rng(0)
    clouds = [CloudScan(k * SECOND, "eye", rng.uniform(1.0, 2.0, (4000, 3))) for k in range(60)]
    clouds[3].points[:] = np.nan
    poses = Trajectory(np.arange(60) * SECOND, np.array([planar_transform(10.0 * k, 0.0, 0.0) for k in range(60)]))
    points, again = (points_of_map(Log([*clouds], Path("log")), rig("cloud", Mount()), poses) for _ in range(2))
    np.testing.assert_array_equal(points, again)
    assert 0.9 * MOST_POINTS < len(points) <= MOST_POINTS
    assert np.ptp(points[:, 0]) > 590.0 - 1.0  # from the first to the last
    assert len(points_of_map(Log([], Path("log")), rig("cloud"), Trajectory.empty())) == 0


def test_they_are_kept_to_the_centimetre(tmp_path: Path):
    points = np.array([[1.234, -5.678, 0.005], [1e3, 0.0, -2.0]])
    History.of([], points=points).write(tmp_path / "view.json")
    np.testing.assert_allclose(History.read(tmp_path / "view.json").points, points, atol=0.0051)
    (tmp_path / "view.json").write_text((tmp_path / "view.json").read_text().replace("points_cm", "other"))
    assert len(History.read(tmp_path / "view.json").points) == 0  # as earlier versions wrote it
