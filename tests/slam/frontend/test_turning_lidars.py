"""Clouds of a lidar that turns while it moves: where a turn begins, what is seen taken at once, and its errors."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from slam.frontend.deskewing import Sweeps
from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import inverse, lift
from slam.sensors.log import OdometryReading
from slam.sensors.rig import Mount, Sensor
from slam.sensors.wheel_noise import OdometryNoise
from spplanes import fit_plane
from spplanes.clouds.turn import TurnBegin, begin_of

SECOND_NS, TURN_S = 1_000_000_000, 0.1
#: (rotation, translation) of the body, rad/s and m/s.
TWIST = np.array([0.1, -0.2, 1.1, 0.9, 0.3, -0.1])
MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, 0.2, 0.7), np.array([0.3, -0.1, 1.0])).matrix()
SENSOR = Sensor(kind="cloud", body_T_sensor=Mount.of(MOUNT), range_sigma_m=0.01, range_max_m=60.0, sweep_s=TURN_S)


def pose_at(seconds: float, twist: np.ndarray = TWIST) -> np.ndarray:
    return gtsam.Pose3.Expmap(seconds * twist).matrix()


def track(twist: np.ndarray = TWIST, span_s: float = 0.5) -> OdometryTrack:
    times = np.arange(-span_s, span_s + 1e-9, 0.0125)
    readings = [OdometryReading(SECOND_NS + round(1e9 * t), pose_at(t, twist)) for t in times]
    return OdometryTrack(readings, OdometryNoise(), can_jump=False)


def world_points(rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(1.0, 20.0, (count, 1))


def swept(points: np.ndarray, begin: TurnBegin) -> np.ndarray:
    """Points (N, 3) in the frame of the sensor at its stamp, as the turning and moving sensor sees them."""
    seen = points.copy()
    for _ in range(20):  # when a point is seen depends on where it is seen
        times = TURN_S * (begin.turned(seen) - 0.5)
        poses = np.array([pose_at(t) for t in times]) @ MOUNT
        seen = np.einsum("nij,nj->ni", np.linalg.inv(poses)[:, :3, :3], lift(points, MOUNT) - poses[:, :3, 3])
    return seen


@pytest.mark.parametrize("begin", [TurnBegin(-2.0), TurnBegin(1.0, clockwise=True)])
def test_what_is_seen_in_a_turn_is_taken_at_its_stamp(begin):
    points = world_points(np.random.default_rng(1))
    seen = swept(points, begin)
    settled = np.abs(begin.turned(seen) - 0.5) < 0.49  # at the seam a point is seen twice, or never
    settled &= np.abs(begin.turned(points) - 0.5) < 0.45
    assert np.linalg.norm(seen - points, axis=1).max() > 0.05
    seen[7] = np.nan
    straight = Sweeps(track(), np.zeros((6, 6))).unswept(seen, SENSOR, SECOND_NS, begin)
    assert np.isnan(straight[7]).all()
    settled[7] = False
    np.testing.assert_allclose(straight[settled], points[settled], atol=5e-4)
    grid = Sweeps(track(), np.zeros((6, 6))).unswept(seen.reshape(40, 100, 3), SENSOR, SECOND_NS, begin)
    np.testing.assert_array_equal(grid.reshape(-1, 3), straight)


def test_beyond_its_readings_a_body_goes_on_as_it_did():
    short = track(span_s=0.1)
    for seconds in (-0.15, 0.05, 0.15):
        onward = short.onward([SECOND_NS + round(1e9 * seconds)])[0]
        np.testing.assert_allclose(onward, pose_at(seconds), atol=1e-9)


def turn(rings: int, steps: int, first_deg: float, way: float) -> np.ndarray:
    """Points of a turn, step by step, (steps, rings, 3)."""
    azimuths = np.deg2rad(first_deg) + way * 2.0 * np.pi * np.arange(steps) / steps
    heights = np.deg2rad(np.linspace(-15.0, 15.0, rings))
    ranges = 5.0 + np.random.default_rng(2).uniform(0.0, 1.0, (steps, rings))
    level = np.cos(heights) * ranges
    rise = np.broadcast_to(np.sin(heights), level.shape) * ranges
    return np.stack((np.cos(azimuths)[:, None] * level, np.sin(azimuths)[:, None] * level, rise), axis=-1)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("first_deg", [-170.0, 30.0])
def test_the_order_of_points_tells_where_a_turn_begins(way, first_deg):
    steps = turn(16, 900, first_deg, way)
    holes = steps.copy()
    holes[200:300], holes[::7] = np.nan, np.nan  # glass, and steps without a return
    for points in (steps, steps.swapaxes(0, 1), steps.reshape(-1, 3), holes):
        found = begin_of(points)
        assert found is not None
        assert found.clockwise == (way < 0.0)
        assert abs(np.angle(np.exp(1j * (found.azimuth_rad - np.deg2rad(first_deg))))) < np.deg2rad(1.5)


def test_points_in_no_order_of_time_tell_nothing():
    steps = turn(16, 900, 0.0, 1.0)
    shuffled = np.random.default_rng(3).permutation(steps.reshape(-1, 3))
    ring_by_ring = steps.swapaxes(0, 1).reshape(-1, 3)
    half = steps[:450]
    for points in (shuffled, ring_by_ring, half.reshape(-1, 3), half, np.zeros((0, 3)), np.full((600, 3), np.nan)):
        assert begin_of(points) is None


def test_planes_err_by_what_the_motion_within_a_turn_does():
    """Of 1,500 twists drawn, planes through what is taken for seen at once err as their covariances say: mean NEES."""
    rng, begin = np.random.default_rng(4), TurnBegin(-np.pi)
    wall = np.column_stack((rng.uniform(-3.0, 5.0, 400), np.full(400, 4.0), rng.uniform(-1.0, 2.0, 400)))
    noise = np.broadcast_to(1e-8 * np.eye(3), (400, 3, 3))
    spread = rng.normal(size=(6, 6)) * np.repeat([0.004, 0.01], 3)[:, None]
    twists = spread @ spread.T
    sweeps = Sweeps(track(), twists)
    exact = fit_plane(wall, noise, shared_error=False)
    stated = sweeps.blurred(exact, wall, SENSOR, begin)
    times = TURN_S * (begin.turned(wall) - 0.5)
    nees = []
    for error in rng.multivariate_normal(np.zeros(6), twists, 1500):
        in_sensor = gtsam.Pose3(inverse(MOUNT)).AdjointMap() @ error
        bent = wall + times[:, None] * (in_sensor[3:] + np.cross(in_sensor[:3], wall))
        found = fit_plane(bent, noise, shared_error=False)
        x, y, z = exact.frame[:3, :3].T @ found.normal  # z(x, y) = p_z - theta x + psi y
        off = np.array([(found.d - found.normal @ exact.frame[:3, 3]) / z, x / z, -y / z])
        nees.append(off @ np.linalg.solve(stated.covariance, off))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_wheels_err_within_a_turn_as_they_do():
    sweeps = Sweeps.of_wheels(track(np.array([0.0, 0.0, 0.4, 0.5, 0.0, 0.0])), SECOND_NS, TURN_S)
    half = OdometryNoise().random_covariances([(0.025, 0.0, 0.02)])[0] / 0.05**2
    planar = sweeps.twist_covariance[np.ix_([3, 4, 2], [3, 4, 2])]
    np.testing.assert_allclose(planar, half, rtol=0.01, atol=5e-5)
    assert not sweeps.twist_covariance[[0, 1, 5]].any()
