"""When a keyframe's linear factors are wrong by more than they say."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.frontend.observations import PlaneObservation
from slam.mapping.map_update import bends
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
    assert bends(turn, [wall(5.0, 0.0009)])
    assert not bends(turn, [wall(5.0, 0.0011)])
    assert bends(turn, [wall(5.0, 0.0011), wall(8.0, 0.0015)])
    assert not bends(np.eye(3), [wall(5.0, 1e-5)])
    assert not bends(turn, [])
