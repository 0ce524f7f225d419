"""Which planes may start a landmark."""

from __future__ import annotations

import numpy as np
import pytest
from shapely.geometry import box

from slam.config import LandmarkConfig
from slam.frontend.observations import PlaneObservation
from slam.mapping.map_update import may_start
from spplanes import Plane


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
