"""Inputs nobody means to give: the right answer, or a sentence that names the argument."""

import numpy as np
import pytest
import shapely

from spplanes import LineConfig, Location, Moments, Plane, ScanLine, extract_lines, fit_plane
from spplanes.noise import SensorModel
from spplanes.registration import register_scans
from spplanes.spmodel import rows_of

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1, 1, (40, 3)) * (2, 1, 0) + (0, 0, 1) + RNG.normal(0, 0.01, (40, 3))
COVARIANCES = np.tile(1e-4 * np.eye(3), (40, 1, 1))
PLANE = Plane(np.eye(4), 1e-4 * np.eye(3), 5)
POSE, SENSOR = Location.pose(np.eye(4), np.eye(6)), SensorModel(0.01)
LIFTED = np.eye(4) + 0.5 * np.outer(np.eye(4)[2], np.eye(4)[3])
LINE = ScanLine(0.1, 1.0, 1e-4 * np.eye(2), np.zeros((2, 2)), np.arange(3))


@pytest.mark.parametrize(
    "points",
    [POINTS.astype(complex), POINTS.astype(str), np.ma.array(POINTS, mask=POINTS > 1.01), POINTS.astype("M8[s]"), None],
)
def test_what_is_not_real_numbers_is_refused(points):
    with pytest.raises(ValueError, match="points: expected"):
        fit_plane(points, sigma=0.01)


@pytest.mark.parametrize("sigma", [0, -1, np.nan, np.inf, "0.01", [0.01], np.array([0.01]), 1j, True, 1e-200, 1e200])
def test_bad_sigma(sigma):
    with pytest.raises(ValueError, match="sigma: expected "):
        fit_plane(POINTS, sigma=sigma)


@pytest.mark.parametrize("method", ["ml", "sp"])
@pytest.mark.parametrize("scale", [1e-160, 1e100, 1e300])
def test_magnitudes_whose_products_leave_the_floats(scale, method):
    message = r"points: expected coordinates within 1e\+15 m|sigma: expected (1e-15 to|a number from 1e-50)"
    with pytest.raises(ValueError, match=message):
        fit_plane(POINTS * scale, sigma=0.01 * scale, method=method)
    with pytest.raises(ValueError, match=r"covariances: expected the largest entries in 1e-30 to 1e\+30 m\^2, got"):
        fit_plane(POINTS, COVARIANCES * (1e40 if scale > 1 else 1e-40), method=method)


@pytest.mark.parametrize("method", ["ml", "sp"])
@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e9])
def test_the_unit_of_length_does_not_matter(scale, method):
    one, other = (fit_plane(POINTS * s, sigma=0.01 * s, method=method) for s in (1.0, scale))
    np.testing.assert_allclose(other.normal, one.normal, atol=1e-9)
    unit = np.array([scale, 1.0, 1.0]) * np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose(other.covariance / np.outer(unit, unit), np.eye(3), atol=1e-6)


def test_read_only_arrays_share_their_memory_and_the_compiled_kernels():
    from spplanes.fitting import _groups as _fit_groups

    fit_plane(POINTS, COVARIANCES)
    compiled = len(_fit_groups._run.signatures)
    points, covariances = POINTS.copy(), np.broadcast_to(1e-4 * np.eye(3), (40, 3, 3))
    points.flags.writeable = False
    np.testing.assert_array_equal(fit_plane(points, covariances).frame, fit_plane(POINTS, COVARIANCES).frame)
    assert len(_fit_groups._run.signatures) == compiled
    assert not points.flags.writeable


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane(np.eye(4), np.eye(3), -1), "n_points: expected a whole number >= 0, got -1"),
        (lambda: Plane(np.eye(4), np.eye(3), 2.5), "n_points: expected a whole number >= 0, got 2.5"),
        (lambda: Plane(np.eye(4), np.eye(3), 3, shapely.MultiPolygon()), "outline: expected a shapely Polygon or None"),
        (lambda: Plane(np.eye(4), np.eye(3), chi2="a"), "chi2: expected a number, got 'a'"),
        (lambda: Plane.from_hesse((0, 0, 1), None, np.eye(3)), "d: expected a number, got None"),
        (lambda: Plane.from_hesse((0, 0, 2), 1.0, np.eye(3)), "normal: expected a unit vector, got one of length 2"),
        (lambda: Plane.from_hesse((0, 0, 1), np.nan, np.eye(3)), "d: expected a finite number, got nan"),
        (lambda: Plane.from_hesse((0, 0, 1), 1.0, np.eye(2)), r"covariance: expected shape \(3, 3\), got \(2, 2\)"),
        (lambda: Plane.from_hesse((0, 0, 1), 1.0, -np.eye(4)), "covariance: expected a positive semidefinite"),
        (lambda: Plane.from_dict({"frame": np.eye(4).tolist()}), "data: expected the key 'normal', got"),
        (lambda: Plane.from_dict([]), "data: expected a dict, got list"),
        (lambda: PLANE.merge(Plane(np.eye(4), np.zeros((3, 3)))), "other: expected a plane with a regular covariance"),
        (lambda: PLANE.merge(Plane(np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(3))), "other: expected a plane seen from"),
        (lambda: PLANE.distance([0, 0]), r"points: expected shape \(N, 3\) or \(3,\), got \(2,\)"),
        (lambda: PLANE.project(None), r"points: expected shape \(N, 3\) or \(3,\), got \(\)"),
        (lambda: PLANE.merge(3), "other: expected a Plane, got int"),
        (lambda: PLANE.mahalanobis(LINE), "other: expected a Plane, got ScanLine"),
        (lambda: LINE.mahalanobis(PLANE), "other: expected a ScanLine, got Plane"),
        (lambda: Location.robot_2d([1], 2, 0, np.eye(3)), r"x: expected a number, got \[1\]"),
        (lambda: Location.pose([[1, 2], [1]], np.eye(6)), "transform: expected an array of numbers, got list"),
        (lambda: Location(np.eye(4), np.eye(6), (0, 1, 2)), r"covariance: expected shape \(3, 3\), got \(6, 6\)"),
        (lambda: Location(np.eye(4), -np.eye(6)), "covariance: expected a positive semidefinite covariance"),
        (lambda: Location(np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(6)), "transform: expected a right-handed rotation"),
        (lambda: POSE.compose(POSE, np.zeros((2, 6))), r"cross: expected shape \(6, 6\), got \(2, 6\)"),
        (lambda: POSE.compose(POSE, 2.0 * np.eye(6)), "cross: expected a positive semidefinite covariance"),
        (lambda: rows_of(("roll",)), "names: expected some of x, y, z, phi, theta, psi, got 'roll'"),
        (lambda: Location(np.eye(4), np.eye(2), (1, 0)), r"rows: expected ascending, distinct rows .* got \(1, 0\)"),
        (lambda: Location(np.eye(4), np.eye(2), (1.5, 3)), "rows: expected ascending, distinct rows out of 0..5"),
        (lambda: Location(np.eye(4), np.eye(2), None), "rows: expected ascending, distinct rows out of 0..5"),
        (lambda: POSE.compose(3), "other: expected a Location, got int"),
        (lambda: POSE.relative(PLANE), "other: expected a Location, got Plane"),
        (lambda: Moments.from_points(np.eye(3), np.zeros(3)), "weights: expected at least one positive weight"),
        (lambda: Moments.from_points(np.eye(3), [1, -1, 1]), "weights: expected no negative weight, got -1"),
        (lambda: Moments.from_points(np.eye(3), [1, 1]), r"weights: expected shape \(3,\), got \(2,\)"),
        (lambda: Moments.from_points(np.empty((0, 3))), "points: expected at least 1 point, got 0"),
        (lambda: Moments.from_points([[np.nan, 0, 0]]), "points: expected finite numbers"),
        (lambda: Moments.from_points(np.eye(3)[:2]).plane(), "points: expected at least 3 points, got 2"),
        (lambda: Moments.from_points(np.ones((3, 3))).plane(), "points: .* span a plane, got 3 coincident ones"),
        (lambda: Moments.from_points(np.outer((1, 2, 4), (0.1, 0.1, 0.3))).plane(), "span a plane, got 3 collinear"),
        (lambda: Moments.from_points(np.eye(3)).merge(3), "other: expected a Moments, got int"),
        (lambda: ScanLine("x", 1, np.eye(2), np.eye(2), [1]), "alpha: expected a number, got 'x'"),
        (lambda: ScanLine(0, [1], np.eye(2), np.eye(2), [1]), r"rho: expected a number, got \[1\]"),
        (lambda: ScanLine(0, 1, np.eye(2), np.eye(2), None), "indices: expected integers of shape"),
        (lambda: ScanLine(0, -0.1, np.eye(2), np.eye(2), [1]), "rho: expected a finite distance >= 0, got -0.1"),
        (lambda: ScanLine(np.nan, 1, np.eye(2), np.eye(2), [1]), "alpha: expected a finite angle, got nan"),
        (lambda: ScanLine(0, 1, [[1, 0.5], [0, 1]], np.eye(2), [1]), "covariance: expected a symmetric covariance"),
        (lambda: ScanLine(0, 1, [[1, 2], [2, 1]], np.eye(2), [1]), "covariance: expected a positive semidefinite"),
        (lambda: ScanLine(0, 1, np.eye(3), np.eye(2), [1]), r"covariance: expected shape \(2, 2\), got \(3, 3\)"),
        (lambda: ScanLine(0, 1, np.eye(2), [[0, np.nan], [1, 1]], [1]), "endpoints: expected finite numbers"),
        (lambda: LINE.transform(LIFTED), "T: expected a motion in the scan plane"),
        (lambda: SENSOR.covariances(np.zeros((2, 3))), "got a range of 0"),
        (lambda: SENSOR.covariances(np.zeros((2, 2))), r"expected shape \(\.\.\., 3\)"),
        (lambda: SensorModel(-0.1), "range_sigma_m: expected a finite number, 0 or more"),
        (lambda: SensorModel(0.0), "range_sigma_m: expected some error"),
        (lambda: SensorModel(0.1, bearing_sigma_rad=np.nan), "bearing_sigma_rad"),
        (
            lambda: register_scans([[1.0, 2.0]], [0, 1, 2], np.eye(4)[None], SENSOR),
            "ranges: expected 3 beams a scan, one per angle, got 2",
        ),
        (lambda: LineConfig(significance="a"), "significance: expected a number, got 'a'"),
        (
            lambda: extract_lines(np.ones(181), np.arange(-90.0, 91.0), sigma=0.1),
            "angles: expected bearings in radians, got 90, as if in degrees",
        ),
        (lambda: extract_lines([1.0], [0.0], sigma=0.1, config={}), "config: expected a LineConfig, got dict"),
    ],
)
def test_one_sentence_that_names_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_location_does_not_change_with_the_callers_array():
    transform = np.eye(4)
    location = Location.pose(transform, np.eye(6))
    transform[0, 3] = 9.0
    assert location.transform[0, 3] == 0.0


def test_lines_by_hand_are_put_in_range():
    line = ScanLine(10.0, np.float32(1), np.eye(2).tolist(), [[1, 0], [1, 1]], [0, 1])
    assert line.alpha == pytest.approx(10.0 - 4 * np.pi)
    assert line.indices.dtype == np.int64


def test_certain_lines_have_a_distance():
    """Where both lines are certain a difference is infinite, and none is 0; the rest counts as ever."""
    certain, other = (ScanLine(a, 1.0, np.zeros((2, 2)), np.eye(2), [0]) for a in (0.0, 0.1))
    assert certain.mahalanobis(certain) == 0.0
    assert certain.mahalanobis(other) == np.inf
    half, shifted = (ScanLine(0.0, r, np.diag([0.0, 0.5e-4]), np.eye(2), [0]) for r in (1.0, 1.02))
    assert half.mahalanobis(shifted) == pytest.approx(4.0)
