"""Rounded coordinates: the step is found, planes are no surer than it lets them be, and all others stay as they are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spplanes import fit_plane, segment_cloud
from spplanes.fitting.rounding import coordinate_steps, with_rounding
from tests.statistics import assert_mean_in_band

STEP_M = 0.01
NORMAL, UTM = np.random.default_rng(0).normal(size=(9_000, 3)), np.array([5e5, 4.5e6, 0.1])


def chi2_of_offsets(noise_m: float, degrees: float, runs: int = 80) -> np.ndarray:
    """Squared errors over what is claimed of the offset of rounded walls of 4 x 2 m, turned about y and x, (runs,)."""
    rng, values = np.random.default_rng(7), []
    rotation = Rotation.from_euler("YX", (degrees, degrees), degrees=True).as_matrix()
    for _ in range(runs):
        sides = rng.uniform(-2.0, 2.0, 3000), rng.uniform(-1.0, 1.0, 3000)
        flat = np.column_stack((*sides, noise_m * rng.normal(size=3000)))
        centre = np.array([0.0, 0.0, 1.0 + rng.uniform(0.0, STEP_M)])
        points = np.round((flat @ rotation.T + centre) / STEP_M) * STEP_M
        plane = fit_plane(points, sigma=noise_m, viewpoint=(0.0, 0.0, 9.0))
        off = rotation[:, 2] @ (centre - plane.centre) / (rotation[:, 2] @ plane.normal)
        values.append(off**2 / plane.covariance[0, 0])
    return np.array(values)


@pytest.mark.parametrize(("noise_m", "least"), [(0.0005, 0.3), (0.001, 0.3), (0.002, 0.3), (0.003, 0.05)])
def test_walls_across_an_axis_are_no_surer_than_the_rounding_lets_them_be(noise_m, least):
    """By the scatter alone the mean chi2 is beyond 1000."""
    assert least < chi2_of_offsets(noise_m, 0.0).mean() < 1.3


@pytest.mark.parametrize(
    ("noise_m", "degrees"), [(0.005, 0.0), *((noise_m, 10.0) for noise_m in (0.0005, 0.001, 0.002, 0.003, 0.005))]
)
def test_by_more_noise_than_half_a_step_and_of_skewed_walls_the_rounding_averages_out(noise_m, degrees):
    assert_mean_in_band(chi2_of_offsets(noise_m, degrees), 1, 0.999)


def test_a_wall_of_one_rounded_value_claims_no_more_than_that_and_the_cloud_says_so():
    points = np.round(np.random.default_rng(0).normal([0.0, 0.0, 1.003], [1.0, 1.0, 0.001], (20_000, 3)), 2)
    found = segment_cloud(points)
    assert np.sqrt(found.planes[0].covariance[0, 0]) == pytest.approx(STEP_M / 12**0.5, rel=0.05)
    assert any("coordinates come in steps of 0.01 m" in one for one in found.warnings)


COORDINATES = {
    "cm": (np.round(NORMAL, 2), 0.01),
    "float32 cm": (np.round(NORMAL, 2).astype(np.float32), 0.01),
    "UTM mm": (np.round(NORMAL, 3) + UTM, 0.001),
    "continuous": (NORMAL, 0.0),
    "float32 UTM": ((NORMAL + UTM).astype(np.float32), (1.0 / 32.0, 0.5, 0.0)),
    "cm, one height": (np.round(NORMAL, 2) * [1.0, 1.0, 0.0] + UTM, 0.01),
    "one height": (NORMAL * [1.0, 1.0, 0.0], 0.0),
    "one": (np.ones((50, 3)), 0.0),
    "NaN": (np.full((50, 3), np.nan), 0.0),
    "none": (np.empty((0, 3)), 0.0),
}


@pytest.mark.parametrize(("points", "steps"), COORDINATES.values(), ids=COORDINATES)
def test_the_step_of_coordinates(points, steps):
    found = coordinate_steps(np.asarray(points, dtype=np.float64))
    np.testing.assert_allclose(found, np.broadcast_to(steps, 3), rtol=1e-6)


def test_a_mesh_of_one_height_is_not_rounded_to_its_cells_and_covariances_without_rounding_are_left_alone():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    plane = fit_plane(np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3), sigma=0.01)
    assert np.sqrt(plane.covariance[0, 0]) == pytest.approx(0.01 / 20.0)
    points, covariances = np.random.default_rng(2).normal(size=(3000, 3)) * [2.0, 1.0, 0.005], 1e-8 * np.eye(3)[None]
    for given in (points, np.round(points, 4)):
        assert with_rounding(covariances, covariances, given, np.eye(4)[None], np.array([2.5e-5])) is covariances
