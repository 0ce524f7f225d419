"""What the fits refuse, with the sentence they say; and what they take."""

import tracemalloc
from functools import partial

import numpy as np
import pytest

from spplanes import fit_plane, fit_planes

POINTS = np.random.default_rng(0).normal(size=(20, 3)) * (2, 1, 0.01) + (5, 0, 0)
COVARIANCES = np.tile(1e-4 * np.eye(3), (20, 1, 1))
ONE_SCAN = {"sigma": 0.1, "scan_index": np.zeros(20, int), "pose_covariances": np.zeros((1, 6, 6))}


def changed(index, matrix):
    result = COVARIANCES.copy()
    result[index] = matrix
    return result


def line(n):
    return np.linspace(0, 1, n)[:, None] * (0.3, 0.4, 0.7) + (1.0, 2.0, 3.0)


@pytest.mark.parametrize("method", ["ml", "sp"])
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (POINTS[:2], "points: expected at least 3 points, got 2"),
        (np.empty((0, 3)), "points: expected at least 3 points, got 0"),
        (line(10), "points: expected points that span a plane, got 10 collinear ones"),
        (line(10) + 1e6, "points: expected points that span a plane, got 10 collinear ones"),
        (np.ones((5, 3)), "points: expected points that span a plane, got 5 coincident ones"),
        (np.full((5, 3), 1e6 / 3), "points: expected points that span a plane, got 5 coincident ones"),
        (np.where(np.eye(20, 3, -4), np.nan, POINTS), r"points: expected finite numbers, got \[nan, .*\] at index 4"),
        (np.where(np.eye(20, 3, -4), np.inf, POINTS), r"points: expected finite numbers, got \[inf, .*\] at index 4"),
        (POINTS[:, :2], r"points: expected shape \(N, 3\), got \(20, 2\)"),
        (POINTS[0], r"points: expected shape \(N, 3\), got \(3,\)"),
        ([[1, 2, 3], [1, 2]], "points: expected an array of numbers, got list"),
    ],
)
def test_bad_points(points, message, method):
    with pytest.raises(ValueError, match=message):
        fit_plane(points, sigma=0.01, method=method)


@pytest.mark.parametrize(
    ("covariances", "message"),
    [
        (COVARIANCES[:19], r"covariances: expected shape \(20, 3, 3\), one for each point, got \(19, 3, 3\)"),
        (COVARIANCES[0], r"covariances: expected shape \(20, 3, 3\), one for each point, got \(3, 3\)"),
        (changed(3, np.nan), "covariances: expected finite numbers, got NaN or infinity at index 3"),
        (changed(2, np.triu(np.ones((3, 3)))), "covariances: expected symmetric matrices, got one .* at index 2"),
        (changed(5, np.diag([1, 1, -1e-3])), "semidefinite matrices, got smallest eigenvalue -0.001 at index 5"),
        (changed(5, np.diag([-1, 1, 1])), "covariances: expected positive semidefinite matrices"),
        (changed(5, [[1, 2, 0], [2, 1, 0], [0, 0, 1]]), "semidefinite matrices, got smallest eigenvalue -1 at index 5"),
        (changed(5, [[1, 0, 0], [0, 1, 2], [0, 2, 1]]), "semidefinite matrices, got smallest eigenvalue -1 at index 5"),
        (changed(6, np.zeros((3, 3))), "covariances: expected some uncertainty in every point, got a zero matrix at"),
    ],
)
def test_bad_covariances(covariances, message):
    for method in ("ml", "sp"):
        with pytest.raises(ValueError, match=message):
            fit_plane(POINTS, covariances, method=method)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "covariances: expected either them or sigma, got neither"),
        ({"covariances": COVARIANCES, "sigma": 0.1}, "covariances: expected either them or sigma, got both"),
        ({"sigma": 0.1, "method": "lsq"}, r"method: expected one of \('ml', 'sp'\), got 'lsq'"),
        ({"sigma": 0.1, "robust": "huber"}, r"robust: expected one of \(None, 'tukey'\), got 'huber'"),
        ({"sigma": 0.1, "robust": "tukey", "method": "sp"}, "robust: expected None with method 'sp', got 'tukey'"),
        ({"sigma": 0.1, "viewpoint": [0, 0]}, r"viewpoint: expected shape \(3,\), got \(2,\)"),
        ({"sigma": 0.1, "viewpoint": [0, 0, np.nan]}, "viewpoint: expected finite numbers"),
        ({"sigma": 0.1, "scan_index": np.zeros(20, int)}, "pose_covariances: expected it beside"),
        ({"sigma": 0.1, "pose_covariances": np.zeros((1, 6, 6))}, "scan_index: expected it beside"),
        (ONE_SCAN | {"pose_covariances": np.eye(7)}, r"pose_covariances: expected shape .* or .*, got \(7, 7\)"),
        (ONE_SCAN | {"scan_index": np.ones(20, int)}, r"scan_index: expected indices of 1 scans, got 1\.\.1"),
        (ONE_SCAN | {"scan_index": np.zeros(20)}, "scan_index: expected 20 integers, .* got float64"),
        (ONE_SCAN | {"pose_covariances": -np.eye(6)[None]}, "pose_covariances: expected a positive semidefinite"),
        (ONE_SCAN | {"scan_origins": [[0, 0]]}, r"scan_origins: expected shape \(1, 3\), got \(1, 2\)"),
    ],
)
def test_bad_options(arguments, message):
    with pytest.raises(ValueError, match=message):
        fit_plane(POINTS, **arguments)


@pytest.mark.parametrize(
    ("points", "labels", "message"),
    [
        (POINTS, None, "labels: expected 20 integers, one for each point, got object"),
        (POINTS, np.zeros(20), "labels: expected 20 integers, one for each point, got float64"),
        (POINTS, np.where(np.arange(20) < 2, 7, 1), "points of label 7: expected at least 3 points, got 2"),
        (np.concatenate([POINTS, line(5)]), np.repeat([3, 9], [20, 5]), "points of label 9: .* plane, got 5 collinear"),
    ],
)
@pytest.mark.parametrize("robust", [None, "tukey"])
def test_bad_labels(points, labels, message, robust):
    with pytest.raises(ValueError, match=message):
        fit_planes(points, sigma=0.1, labels=labels, robust=robust)


def test_points_without_a_label_are_left_out():
    assert fit_planes(POINTS, COVARIANCES, np.full(20, -1)) == []
    for none in (np.empty(0, int), []):
        assert fit_planes(np.empty((0, 3)), sigma=1.0, labels=none) == []


def test_singular_covariances_work():
    """Rank 1 and rank 2, in skew directions, rounding included."""
    rng = np.random.default_rng(1)
    for rank in (1, 2):
        root = 0.01 * rng.normal(size=(20, 3, rank))
        for method in ("ml", "sp"):
            plane = fit_plane(POINTS, root @ root.transpose(0, 2, 1), method=method)
            assert np.linalg.eigvalsh(plane.covariance)[0] > 0.0


def test_other_layouts_and_types_are_taken_and_left_alone():
    points, covariances = POINTS.copy(), COVARIANCES.copy()
    reference = fit_plane(POINTS, COVARIANCES)
    for other in (np.ndarray.tolist, np.asfortranarray, lambda array: np.repeat(array, 2, axis=0)[::2]):
        np.testing.assert_array_equal(fit_plane(other(POINTS), other(COVARIANCES)).frame, reference.frame)
    single = fit_plane(POINTS.astype(np.float32), COVARIANCES.astype(np.float32))
    np.testing.assert_allclose(single.frame, reference.frame, atol=1e-5)
    fit_plane(POINTS, COVARIANCES, robust="tukey")
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(covariances, COVARIANCES)


@pytest.mark.parametrize("options", [{}, {"method": "sp"}, {"robust": "tukey"}])
def test_peak_memory_is_below_one_copy_of_the_input(options):
    rng = np.random.default_rng(2)
    points = rng.normal(size=(50_000, 3)) * (2, 1, 0.01)
    covariances = np.tile(1e-4 * np.eye(3), (50_000, 1, 1))
    labels = rng.integers(0, 500, 50_000)
    for task in (partial(fit_plane, points, covariances), partial(fit_planes, points, covariances, labels)):
        task(**options)
        tracemalloc.start()
        task(**options)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < points.nbytes + covariances.nbytes
