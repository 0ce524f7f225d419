import numpy as np
import pytest
from scipy.stats import chi2

from spplanes import Moments
from spplanes._rows import merge_scaled
from spplanes.fitting._moment_patches import eigenvalues, normal_of, variance_along
from spplanes.segmentation.clustering import cells
from spplanes.segmentation.clustering.ahc import cluster, one_plane_chi2, step_chi2
from spplanes.segmentation.refinement import creases, dissolving
from tests.statistics import assert_mean_in_band


def grid_of(points, covariance, labels):
    """A grid of returns as kernels take it, all of it to be labelled."""
    return points, covariance, np.ones(labels.shape, bool), labels, 0


def moments(points, weights):
    return Moments.from_points(points, np.broadcast_to(weights, len(points)).copy()).as_row()


def patch(rng, centre, sigma, n=200):
    x, y = rng.uniform(-0.5, 0.5, (2, n))
    return np.column_stack((x, y, sigma * rng.standard_normal(n))) + centre


def test_eigenvalues_and_normal_agree_with_numpy():
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = rng.normal(size=(20, 3)) * rng.uniform(0.01, 2.0, 3) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        row = moments(points, 1.0)
        values, vectors = np.linalg.eigh((points - points.mean(0)).T @ (points - points.mean(0)))
        np.testing.assert_allclose(eigenvalues(row), values, atol=1e-10 * values[2])
        assert abs(np.array(normal_of(row, eigenvalues(row)[0])) @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_merge_scaled_is_the_union():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 30, 3))
    out = np.empty(11)
    merge_scaled(out, moments(a, 2.0), 0.5, moments(b, 1.0), 3.0)
    np.testing.assert_allclose(out, moments(np.concatenate((a, b)), np.repeat([1.0, 3.0], 30)), atol=1e-10)


def test_variance_along_has_a_floor():
    grid = np.zeros((2, 3, 9))
    grid[1, 2] = np.diag([4.0, 1.0, 0.0]).ravel()
    assert variance_along(grid, 1, 2, 0.6, 0.8, 0.0) == pytest.approx(0.36 * 4 + 0.64)
    assert variance_along(grid, 1, 2, 0.0, 0.0, 1.0) == pytest.approx(5e-3)
    assert variance_along(np.full((1, 1, 1), 0.25), 0, 0, 0.0, 0.0, 1.0) == 0.25


def test_one_plane_chi2_has_three_degrees_of_freedom():
    rng, runs, sigma, work = np.random.default_rng(2), 400, 0.01, np.empty(11)
    values = []
    for _ in range(runs):
        a, b = patch(rng, (0, 0, 0), sigma), patch(rng, (1.0, 0.3, 0), sigma, 120)
        values.append(one_plane_chi2(moments(a, sigma**-2), moments(b, sigma**-2), 0.0, work))
    assert_mean_in_band(values, 3, level=0.998)
    assert np.mean(np.array(values) > chi2.isf(0.01, 3)) < 0.03


def test_cluster_fuses_a_chain_up_to_the_edge():
    rng, sigma = np.random.default_rng(4), 0.005
    flat = [patch(rng, (k, 0, 0), sigma) for k in range(4)]
    steep = [patch(rng, (3.5 + 0.1 * k, 0, 0.5 + k), sigma) @ np.diag([0.1, 1, 1]) for k in range(2)]
    upright = [np.column_stack((4.0 + p[:, 2] * 0 + 0.0 * p[:, 0], p[:, 1], p[:, 0])) for p in steep]
    rows = np.array([moments(p, sigma**-2) for p in [*flat, *upright]])
    edges = np.array([[k, k + 1] for k in range(5)])
    root = cluster(rows, np.zeros((6, 2)), edges, chi2.isf(0.001, [1, 3]), 0.0, 1.0)
    np.testing.assert_array_equal(root[:4], 0)
    assert 0 not in root[4:]
    assert rows[0, 0] == 800


def test_split_regions_numbers_parts_and_keeps_the_settled_one():
    labels = np.array([[-1, 0, 0, -1, 0], [0, -1, 0, -1, 0], [0, 0, -1, -1, 0]])
    parts = labels.copy()
    origin = creases.split_regions(parts, 0, 1)
    np.testing.assert_array_equal(parts, [[-1, 0, 0, -1, 1], [2, -1, 0, -1, 1], [2, 2, -1, -1, 1]])
    np.testing.assert_array_equal(origin, [0, 0])
    parts = np.array([[-1, -1, -1, -1, 0], [0, -1, 0, -1, 0], [0, 0, -1, -1, 0]])
    creases.split_regions(parts, 1, 1)
    np.testing.assert_array_equal(parts[:, 4], 0)
    assert parts[2, 0] != 0


def test_superfluous_strip_dissolves_and_a_real_one_stays():
    rng = np.random.default_rng(5)
    y, z = np.meshgrid(np.linspace(-0.2, 0.2, 32), np.linspace(-0.2, 0.2, 32))
    points = np.stack((3.0 + 0.01 * rng.standard_normal((32, 32)), y, z), axis=-1)
    covariance = np.full((32, 32, 1), 1e-4)
    labels = np.zeros((32, 32), dtype=np.int64)
    labels[:, 12:20] = 1
    planes = np.array([[1.0, 0, 0, 3.0], [1.0, 0, 0, 3.002]])
    pairs, sizes, order = np.array([[0, 1]]), np.array([768, 256]), np.array([1, 0])
    kept = labels.copy()
    assert dissolving.dissolve(grid_of(points, covariance, labels), sizes, order, pairs, planes, 0.0) == 1
    assert (labels == 0).all()
    points[:, 12:20, 0] += 0.02
    sizes[:] = 768, 256
    planes[1, 3] = 3.02
    assert dissolving.dissolve(grid_of(points, covariance, kept), sizes, order, pairs, planes, 0.0) == 0


def test_near_pairs_reach_across_other_regions():
    labels = np.array([[0, 0, 1, 1, 2, -1, -1, 3]] * 4)
    assert {tuple(p) for p in dissolving.near_pairs(labels, 2)} == {(0, 1), (1, 2)}
    assert {tuple(p) for p in dissolving.near_pairs(labels, 3)} == {(0, 1), (1, 2), (0, 2), (2, 3)}


def test_step_chi2_is_chi2_with_one_dof_and_sees_a_step_that_a_tilt_would_bridge():
    rng, work = np.random.default_rng(11), np.empty(11)
    values = []
    for step in (0.0, 0.02):
        for _ in range(300):
            a, b = patch(rng, (0, 0, 0), 0.015), patch(rng, (1.0, 0, step), 0.015)
            values.append(step_chi2(moments(a, 0.015**-2), moments(b, 0.015**-2), 0.0, work))
    without, with_step = np.reshape(values, (2, 300))
    assert without.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / 300))
    information = 1.0 / (2 * 0.015**2 / 200 + 0.015**2 / (400 / 12))
    assert with_step.mean() == pytest.approx(1.0 + 0.02**2 * information, rel=0.1)


def _cell(step, sigma, rng, size=32):
    """Cells on a plane seen along beams slanted by 45 degrees, errors along the beams, with a step in the middle."""
    i, j = np.mgrid[: 8 * size, :size]
    points = np.stack((0.01 * i, 0.01 * j, np.where(j >= size // 2, step, 0.0)), axis=-1)
    points += sigma * rng.standard_normal(i.shape)[..., None] * np.sqrt([0.0, 0.5, 0.5])
    free, variance = np.ones(i.shape, dtype=bool), np.full((*i.shape, 1), sigma**2 / 2.0)
    rows = cells.cell_moments(points, variance, free, size, 0.0)
    planar = np.ones(rows.shape[:2], dtype=bool)
    cells.reject_steps(planar, (points, variance, free, size, 0.0), rows, chi2.isf(0.001 / 16, 1))
    return planar


def test_cells_with_a_step_of_the_noise_are_no_planes_and_slanted_beams_do_not_look_like_one():
    rng = np.random.default_rng(13)
    assert not _cell(0.03, 0.02, rng).any()
    assert _cell(0.0, 0.02, rng).all()
    assert _cell(0.0, 0.04, rng).all()
