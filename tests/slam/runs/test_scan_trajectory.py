"""The pose at every scan: exact where it must be, and no worse than the keyframes it comes from."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from slam.config import SlamConfig
from slam.evaluation import absolute_error
from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import planar_transform
from slam.io.trajectories import Trajectory, read_tum
from slam.output.run_files import points_of_map, write_map
from slam.runs.mapping_run import run_map
from slam.runs.scan_trajectory import carried
from slam.runs.slam_run import run_slam
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from slam.simulation import simulate_mission
from tests.statistics import assert_mean_in_band

SECOND = 1_000_000_000


def arc(times: np.ndarray) -> np.ndarray:
    """A robot that drives an arc of 0.5 m and 0.2 rad a second: pose at some times, shape (N, 4, 4)."""
    return np.array([planar_transform(2.5 * np.sin(a), 2.5 * (1 - np.cos(a)), a) for a in 0.2 * times])


def track_of(times: np.ndarray, poses: np.ndarray) -> OdometryTrack:
    stamps = np.round(times * SECOND).astype(int).tolist()
    readings = [OdometryReading(stamp, pose) for stamp, pose in zip(stamps, poses, strict=True)]
    return OdometryTrack(readings, OdometryNoise())


def test_odometry_that_agrees_with_both_keyframes_is_carried_as_it_is():
    """Any start in the world, odometry in a frame of its own, poses beyond either end by odometry alone."""
    times = np.linspace(0.0, 10.0, 101)
    world_T_odom = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), [4.0, 5.0, 6.0]).matrix()
    stamps, truth = np.round(times * SECOND).astype(np.int64), world_T_odom @ arc(times)
    keyframes = Trajectory(stamps[[20, 50, 80]], truth[[20, 50, 80]])
    found = carried(keyframes, stamps, track_of(times, arc(times)))
    np.testing.assert_array_equal(found.stamps_ns, stamps)
    np.testing.assert_allclose(found.poses, truth, atol=1e-12)
    for row, place in enumerate((20, 50, 80)):
        np.testing.assert_array_equal(found.poses[place], keyframes.poses[row])


def test_a_disagreement_is_spread_along_the_way_and_not_while_the_robot_stands():
    """Straight on for 1 m, a stop of 8 s, 1 m more; the estimate is 10 % longer."""
    times = np.array([0.0, 1.0, 9.0, 10.0])
    odometry = np.array([planar_transform(x, 0.0, 0.0) for x in (0.0, 1.0, 1.0, 2.0)])
    keyframes = Trajectory(np.array([0, 10 * SECOND]), np.array([np.eye(4), planar_transform(2.2, 0.0, 0.0)]))
    wanted = np.array([0.0, 0.5, 1.0, 5.0, 9.0, 9.5, 10.0])
    found = carried(keyframes, np.round(wanted * SECOND).astype(np.int64), track_of(times, odometry))
    np.testing.assert_allclose(found.poses[:, 0, 3], [0.0, 0.55, 1.1, 1.1, 1.1, 1.65, 2.2], atol=1e-12)
    np.testing.assert_allclose(found.poses[:, 1, 3], 0.0, atol=1e-12)


def test_without_odometry_poses_lie_on_the_geodesic_in_time():
    first = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.3), [1.0, 2.0, 3.0])
    step = np.array([0.3, -0.2, 0.5, 1.0, -0.4, 0.2])
    last = first.compose(gtsam.Pose3.Expmap(step))
    base = 1_700_000_000 * SECOND  # so late that doubles hold whole nanoseconds no more
    keyframes = Trajectory(np.array([base, base + 8 * SECOND]), np.array([first.matrix(), last.matrix()]))
    found = carried(keyframes, base + np.array([-1, 0, 2, 6, 8, 9]) * SECOND, None)
    for row, share in enumerate((0.0, 0.0, 0.25, 0.75, 1.0, 1.0)):
        expected = first.compose(gtsam.Pose3.Expmap(share * step)).matrix()
        np.testing.assert_allclose(found.poses[row], expected, atol=1e-12)


def test_nothing_gives_nothing():
    one = Trajectory(np.array([5]), np.eye(4)[None])
    assert len(carried(Trajectory.empty(), np.array([1, 2]), None)) == 0
    assert len(carried(one, np.array([], dtype=np.int64), None)) == 0
    np.testing.assert_array_equal(carried(one, np.array([1, 9]), None).poses, np.tile(np.eye(4), (2, 1, 1)))


def test_between_exact_keyframes_the_error_is_that_of_a_bridge():
    """Odometry of a random walk, half way between two known poses: variance L / 4 of what a metre adds, 400 draws."""
    noise = OdometryNoise(
        along_sigma_m_per_sqrt_m=0.03, lateral_sigma_m_per_sqrt_m=0.03, heading_sigma_rad_per_sqrt_m=1e-9
    )
    random = np.random.default_rng(5)
    times, length, draws = np.linspace(0.0, 10.0, 41), 2.0, 400
    stamps = np.round(times * SECOND).astype(np.int64)
    truth = np.array([planar_transform(x, 0.0, 0.0) for x in np.linspace(0.0, length, len(times))])
    ends, errors = Trajectory(stamps[[0, -1]], truth[[0, -1]]), np.empty((draws, 2))
    for draw in range(draws):
        walked = truth.copy()
        walked[:, :2, 3] += np.cumsum(0.03 * np.sqrt(length / 40) * random.standard_normal((len(times), 2)), axis=0)
        readings = [OdometryReading(t, pose) for t, pose in zip(stamps.tolist(), walked, strict=True)]
        errors[draw] = (carried(ends, stamps, OdometryTrack(readings, noise)).poses[20] - truth[20])[:2, 3]
    assert_mean_in_band((errors**2).ravel() / (0.03**2 * length / 4.0), 1, level=0.998)


def test_keyframes_that_left_the_graph_keep_their_poses():
    config = SlamConfig.model_validate({"thinning": {"passes": 1, "apart": 10}})
    mission = simulate_mission("room", seed=1, laps=3, spacing_m=0.08)
    run = run_slam(mission.log, mission.rig, config)
    assert run.slam.backend.n_left > 0
    scans, truth = run.scan_trajectory, mission.truth.trajectory
    assert absolute_error(scans, truth).translation_m.max() < 0.05
    places = np.searchsorted(scans.stamps_ns, run.trajectory.stamps_ns)
    np.testing.assert_array_equal(scans.poses[places], run.trajectory.poses)


def test_a_map_at_given_poses_has_those_at_every_scan(tmp_path: Path):
    """Scans of other sensors have their own; one without is between its neighbours. Each is known by its own stamp."""
    mission = simulate_mission("corridor", n_scans=40, seed=0)
    events = [
        replace(event, world_T_body=None) if k % 7 == 3 and getattr(event, "sensor", "") == "horizontal" else event
        for k, event in enumerate(mission.log.events)
    ]
    times = sorted({scan.stamp_ns for scan in mission.log.scans()})
    log = replace(mission.log, events=events, stamped_ns={times[4]: times[6] + 1, times[5]: times[6] + 2})
    result = run_map(log, mission.rig, SlamConfig())
    known_by = dict(zip(times, log.as_stamped(times).tolist(), strict=True))
    assert result.scan_trajectory.stamps_ns.tolist() == sorted(known_by.values()) != times
    for scan in log.scans():
        if scan.world_T_body is not None:
            place = int(np.searchsorted(result.scan_trajectory.stamps_ns, known_by[scan.stamp_ns]))
            np.testing.assert_array_equal(result.scan_trajectory.poses[place], scan.world_T_body)
    plain = replace(log, stamped_ns={})
    same = points_of_map(plain, mission.rig, run_map(plain, mission.rig, SlamConfig()).scan_trajectory)
    np.testing.assert_array_equal(points_of_map(log, mission.rig, result.scan_trajectory), same)
    write_map(result, tmp_path, SlamConfig(), mission.rig, title="map")
    assert read_tum(tmp_path / "scans.tum").stamps_ns.tolist() == result.scan_trajectory.stamps_ns.tolist()
