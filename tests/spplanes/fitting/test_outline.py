"""The outline that a fit gives on request: the hull of the points."""

import numpy as np
import pytest
import shapely

from spplanes import fit_plane


def patch(rng: np.random.Generator, n: int = 400) -> np.ndarray:
    return np.column_stack([rng.uniform(-1.0, 1.0, n), rng.uniform(-2.0, 2.0, n), 0.01 * rng.normal(size=n)])


def test_the_hull_holds_every_point_and_nothing_else_changes():
    points = patch(np.random.default_rng(0))
    plain, outlined = fit_plane(points, sigma=0.01), fit_plane(points, sigma=0.01, outline=True)
    assert plain.outline is None
    np.testing.assert_array_equal(plain.covariance, outlined.covariance)
    flat = (points - outlined.centre) @ outlined.frame[:3, :2]
    assert outlined.outline.buffer(1e-9).covers(shapely.multipoints(flat))
    assert outlined.outline.area == pytest.approx(8.0, rel=0.08)


def test_what_a_robust_fit_leaves_out_is_not_in_the_hull():
    rng = np.random.default_rng(1)
    points = patch(rng)
    points[:40] = rng.uniform(-9.0, 9.0, (40, 3)) + np.array([0.0, 0.0, 12.0])
    outlined = fit_plane(points, sigma=0.01, robust="tukey", outline=True)
    assert outlined.outline.area < 8.0


def test_three_points_have_a_triangle():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert fit_plane(corners, sigma=0.01, outline=True).outline.area == pytest.approx(0.5)
