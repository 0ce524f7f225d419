import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from spplanes import Moments
from spplanes._rows import jacobi3, solve3
from spplanes.moments import ROW_SIZE, add_point, merge_rows, smallest_eigen


def cloud(seed, n=60, offset=0.0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * (3.0, 1.0, 0.01) + (1.0, -2.0, 3.0) + offset
    return points, rng.uniform(1.0, 100.0, n)


def assert_same(a, b, rtol=1e-9):
    assert a.n == b.n
    np.testing.assert_allclose(a.weight, b.weight, rtol=rtol)
    np.testing.assert_allclose(a.centre, b.centre, rtol=rtol)
    np.testing.assert_allclose(a.scatter, b.scatter, rtol=rtol, atol=rtol * np.abs(b.scatter).max())


def test_of_four_points_by_hand():
    """Weights 1, 1, 2, 2 at (0,0,0), (6,0,0), (0,3,0), (6,3,6): W = 6, centre (3, 2, 2), scatter from differences."""
    moments = Moments.from_points([[0, 0, 0], [6, 0, 0], [0, 3, 0], [6, 3, 6]], [1, 1, 2, 2])
    assert (moments.n, moments.weight) == (4, 6.0)
    np.testing.assert_allclose(moments.centre, [3, 2, 2])
    # Differences: (-3,-2,-2), (3,-2,-2), (-3,1,-2), (3,1,4).
    np.testing.assert_allclose(moments.scatter, [[54, 0, 36], [0, 12, 12], [36, 12, 48]])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 59))
def test_merge_is_the_moments_of_the_union_in_any_order(seed, cut):
    points, weights = cloud(seed)
    whole = Moments.from_points(points, weights)
    first, second = Moments.from_points(points[:cut], weights[:cut]), Moments.from_points(points[cut:], weights[cut:])
    assert_same(first + second, whole)
    assert_same(second.merge(first), whole)
    order = np.random.default_rng(seed).permutation(len(points))
    assert_same(Moments.from_points(points[order], weights[order]), whole)


def test_a_thousand_kilometres_from_the_origin():
    """The same cloud, coordinates exact in binary, at the origin and 2^20 m away on every axis."""
    points, weights = cloud(3)
    points = np.round(points * 2**20) / 2**20
    near, far = Moments.from_points(points, weights), Moments.from_points(points + 2.0**20, weights)
    first, second = (
        Moments.from_points(points[part] + 2.0**20, weights[part]) for part in (slice(30), slice(30, None))
    )
    for moved in (far, first + second):
        np.testing.assert_allclose(moved.scatter, near.scatter, rtol=1e-9, atol=1e-9 * np.abs(near.scatter).max())


@njit
def _row_of(points, weights, row):
    for i in range(points.shape[0]):
        add_point(row, points[i], weights[i])


def test_kernels_from_compiled_code():
    points, weights = cloud(4)
    row, empty = np.zeros(ROW_SIZE), np.zeros(ROW_SIZE)
    _row_of(points, weights, row)
    whole = Moments.from_points(points, weights)
    assert_same(Moments.from_row(row), whole)
    np.testing.assert_allclose(Moments.from_row(row).as_row(), row)
    merge_rows(row, empty, empty)
    np.testing.assert_array_equal(row, empty)
    value, *normal = smallest_eigen(row)
    np.testing.assert_allclose(whole.scatter @ normal, value * np.array(normal), atol=1e-9 * np.trace(whole.scatter))
    assert value == pytest.approx(np.linalg.eigvalsh(whole.scatter)[0], rel=1e-6)


@pytest.mark.parametrize("spectrum", [(0, 0, 0), (1, 1, 1), (0, 0, 5), (1e-12, 1, 1), (1e-14, 1e-7, 1), (2, 2, 3)])
def test_eigen_solver_on_degenerate_scatters(spectrum):
    rng = np.random.default_rng(7)
    for _ in range(100):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        m = q @ np.diag(spectrum).astype(float) @ q.T
        m = 0.5 * (m + m.T)
        values, vectors = np.empty(3), np.empty((3, 3))
        jacobi3(m[np.triu_indices(3)], values, vectors)
        top = max(spectrum)
        np.testing.assert_allclose(values, spectrum, atol=2e-15 * top)
        np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, m, atol=3e-15 * top)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=3e-15)


def test_a_positive_definite_system_is_solved():
    rng = np.random.default_rng(5)
    for _ in range(50):
        root = rng.standard_normal((3, 3))
        matrix, right = root @ root.T + 0.01 * np.eye(3), rng.standard_normal(3)
        found = solve3.py_func(tuple(matrix[np.triu_indices(3)]), *right)
        assert matrix @ found == pytest.approx(right, abs=1e-9)
