"""When a keyframe's linear factors are wrong by more than they say, and which planes may start a landmark."""

import gtsam
import numpy as np
import pytest
from shapely.geometry import box

from factors.association.observations import PlaneObservation
from slam.config import LandmarkConfig
from slam.mapping.map_update import bends, may_start
from spplanes import Plane, fit_plane


def wall(distance_m: float, sigma_m: float) -> PlaneObservation:
    """Two metres of wall ahead, a hundred points with noise that makes its middle known so well."""
    y, z = np.meshgrid(np.linspace(-1.0, 1.0, 10), np.linspace(-1.0, 1.0, 10))
    points = np.column_stack((np.full(100, distance_m), y.ravel(), z.ravel()))
    plane = fit_plane(points, sigma=10.0 * sigma_m)
    seen = PlaneObservation(Plane(plane.frame, plane.covariance, plane.n_points))
    assert seen.sigma_m == pytest.approx(sigma_m, rel=0.01)
    return seen


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.6, -0.8, 0.0)])
def test_a_turn_bends_what_it_moves_by_more_than_a_sigma_to_second_order(axis: tuple[float, float, float]) -> None:
    """Of a wall at 5 m a turn of 0.02 rad leaves 5 (1 - cos 0.02) = 1.0 mm out."""
    turn = gtsam.Rot3.Expmap(0.02 * np.array(axis)).matrix()
    assert bends(turn, [wall(5.0, 0.0009)]) and not bends(turn, [wall(5.0, 0.0011)])
    assert bends(turn, [wall(5.0, 0.0011), wall(8.0, 0.0015)])
    assert not bends(np.eye(3), [wall(5.0, 1e-5)]) and not bends(turn, [])


def seen(area_m2: float, n_points: int, tilt_sigma_rad: float) -> PlaneObservation:
    side = 0.5 * np.sqrt(area_m2)
    covariance = np.diag([1e-6, tilt_sigma_rad**2, (0.5 * tilt_sigma_rad) ** 2])
    return PlaneObservation(Plane(np.eye(4), covariance, n_points, box(-side, -side, side, side)))


@pytest.mark.parametrize(
    ("area_m2", "n_points", "tilt_sigma_rad", "may"),
    [
        pytest.param(0.3, 40, 0.09, True, id="large"),
        pytest.param(0.3, 20, 0.01, False, id="large, few points"),
        pytest.param(0.3, 500, 0.11, False, id="large, any tilt"),
        pytest.param(0.12, 260, 0.013, True, id="half a lamp"),
        pytest.param(0.12, 180, 0.013, False, id="half a lamp, far"),
        pytest.param(0.12, 260, 0.03, False, id="strip of a board"),
        pytest.param(0.09, 260, 0.013, False, id="edge"),
    ],
)
def test_a_landmark_starts_with_a_plane_that_is_large_or_very_sure(area_m2, n_points, tilt_sigma_rad, may):
    assert may_start(seen(area_m2, n_points, tilt_sigma_rad), LandmarkConfig()) is may
