"""What comes of bad input: one sentence that names the argument, or a documented meaning."""

from copy import copy

import gtsam
import numpy as np
import pytest

from factors import (
    LineObservation,
    copy_graph,
    direction_prior,
    distance_factor,
    get_ready,
    isam2_parameters,
    isam_covariance,
    joint_covariance,
    landmark_anchors,
    line_factor,
    map_prior,
    odometry_factor,
    odometry_factor_2d,
    parallel_factor,
    planar_motion_factor,
    plane_factor,
    plane_factors,
    plane_landmark,
    plane_prior,
    pose_prior,
    seen_plane,
    settle,
    world_plane,
)
from factors.robust import with_robust
from spplanes import Location, Plane, ScanLine
from spplanes._check import as_shape
from tests.factors.factor_scenes import (
    A,
    L,
    X,
    assert_jacobian,
    graph_of,
    make_line,
    random_line,
    random_plane,
    random_pose,
    values_of,
)

PLANE = random_plane(np.random.default_rng(0))
LINE = random_line(np.random.default_rng(0))
WALL, NOTHING, FLOOR = values_of(l0=gtsam.OrientedPlane3()), gtsam.Values(), gtsam.OrientedPlane3(0, 0, 1, 1)
MARGINALS = gtsam.Marginals(gtsam.NonlinearFactorGraph(), gtsam.Values())
WRONG_KEYS = [
    (L, "keys: expected a sequence, got int"),
    ([], "keys: expected at least one, got none"),
    ([L, L], r"keys\[1\]: expected another key than keys\[0\], got l0 for both"),
]
WRONG_SIGMAS = [(0.1, 0.1), (0.1, 0.0, 0.1), (0.1, -1.0, 0.1)]
NO_KERNELS = ["tukey", ("huber",), 3.0, ("huber", 1.0, 2.0)]
WRONG_KERNELS = [("huber", k) for k in (0.0, -1.0, np.nan, np.inf)]


def robust(kernel):
    return plane_factor(PLANE, X, L, robust=kernel)


def line_expecting(expected, anchor_key):
    return line_factor(LINE, np.eye(4), X, L, anchor_key=anchor_key, expected=expected)


def out_of_plane(sigmas):
    return odometry_factor(X, A, (1, 0, 0), np.eye(3), out_of_plane_sigmas=sigmas)


@pytest.mark.parametrize("key", ["x0", 1.0, None, True, -1, 2**64])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda key: plane_factor(PLANE, key, L), "pose_key"),
        (lambda key: line_factor(LINE, np.eye(4), X, key), "plane_key"),
        (lambda key: plane_prior(PLANE, key), "plane_key"),
        (lambda key: odometry_factor(X, key, (1, 0, 0), np.eye(3)), "key_b"),
        (lambda key: planar_motion_factor(key), "pose_key"),
        (lambda key: plane_factor(PLANE, X, L, anchor_key="none" if key is None else key), "anchor_key"),
        (lambda key: line_factor(LINE, np.eye(4), X, L, anchor_key="none" if key is None else key), "anchor_key"),
    ],
)
def test_wrong_keys(make, name, key):
    with pytest.raises(ValueError, match=rf"{name}: expected a GTSAM key \(an integer such as"):
        make(key)


@pytest.mark.parametrize("keys", [np.int64(3), np.uint64(3)])
def test_numpy_integers_are_keys(keys):
    assert list(plane_factor(PLANE, keys, L).keys()) == [3, L]


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_singular_noise(scale):
    flat = Plane(PLANE.frame, scale * np.diag([1.0, 1.0, 0.0]))
    tied = Plane(PLANE.frame, scale * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    for plane in (flat, tied):
        with pytest.raises(ValueError, match=r"plane.covariance: expected a positive definite .* got a singular one"):
            plane_factor(plane, X, L)
        with pytest.raises(ValueError, match=r"plane.covariance: .* got a singular one at index 1"):
            plane_factors([PLANE, plane], [X, X], [L, L])
    with pytest.raises(ValueError, match=r"line.covariance: expected a positive definite .* got a singular one"):
        line_factor(make_line(0.0, 1.0, scale * np.ones((2, 2))), np.eye(4), X, L)
    for build in (odometry_factor, odometry_factor_2d):
        with pytest.raises(ValueError, match=r"covariance: expected a positive definite .* got a singular one"):
            build(X, A, (1, 0, 0), scale * np.diag([1.0, 0.0, 1.0]))


def test_tiny_but_definite_noise_is_accepted_and_long_directions_do_not_overflow():
    """Scale is not singularity: a micrometre beside a radian."""
    plane = Plane(PLANE.frame, np.diag([1e-12, 1e-2, 1.0]))
    assert plane_factor(plane, X, L).error(values_of(x0=gtsam.Pose3(), l0=plane_landmark(plane))) < 1e-6
    assert direction_prior(L, (1e40, 0, 0), 0.1).error(values_of(l0=gtsam.OrientedPlane3(1, 0, 0, 0))) == 0.0


def test_kernels_bite_where_they_should():
    """Half weight of Cauchy at k, of Huber at 2 k; the default at the 95 % quantile."""
    noise = gtsam.noiseModel.Unit.Create(3)
    assert with_robust(noise, "huber", 3).robust().weight(2 * np.sqrt(7.815)) == pytest.approx(0.5)
    assert with_robust(noise, ("cauchy", 1.7), 3).robust().weight(1.7) == pytest.approx(0.5)
    assert with_robust(noise, ("geman-mcclure", 1.7), 3).robust().weight(1.7) == pytest.approx(0.25)
    assert with_robust(noise, ("dcs", 4.0), 3).robust().weight(np.sqrt(12.0)) == pytest.approx(0.25)
    assert with_robust(noise, "dcs", 3).robust().weight(np.sqrt(7.8)) == pytest.approx(1.0)


def test_a_plane_seen_from_behind_has_no_error_or_twice_its_distance():
    """The documented meaning: blind to the side, but for the native error. `facing` settles it beforehand."""
    values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3())
    values.insert(L, gtsam.OrientedPlane3(np.array([*-PLANE.normal, PLANE.d])))
    for anchor in (None, A, X):
        error = plane_factor(PLANE, X, L, anchor_key=anchor).unwhitenedError(values)
        np.testing.assert_allclose(error, [0.0, 0.0, -2.0 * PLANE.d if anchor == A else 0.0], atol=1e-3)
    line = make_line(0.0, 2.0, np.diag([0.01, 0.01]))
    for normal in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)):
        behind = gtsam.OrientedPlane3(np.array([*normal, -2.0 * normal[0]]))
        error = line_factor(line, np.eye(4), X, L).unwhitenedError(values_of(x0=gtsam.Pose3(), l0=behind))
        np.testing.assert_allclose(error, 0.0, atol=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-3, 0.0199, 0.0201, 0.1])
def test_a_plane_parallel_to_the_scan_plane(tilt):
    """It cuts the scan plane nowhere useful: bounded error, finite and right derivatives, no exception."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        turn = rng.uniform(0, 2 * np.pi)
        normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        values = values_of(x0=gtsam.Pose3(), l0=gtsam.OrientedPlane3(np.array([*normal, -0.3])))
        factor = line_factor(random_line(rng), np.eye(4), X, L)
        assert np.abs(factor.unwhitenedError(values)).max() < 60.0
        assert_jacobian(factor, values, tolerance=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: plane_factor(LINE, X, L), "plane: expected a Plane, got ScanLine"),
        (lambda: plane_factors(PLANE, X, L), "planes: expected a sequence, got Plane"),
        (lambda: plane_factors([PLANE], [X, X], [L]), r"planes: expected as many as pose_keys, .* got 1, 2, 1, 1"),
        (lambda: plane_landmark(None), "plane: expected a Plane, got NoneType"),
        (lambda: line_factor(LINE, np.diag([1.0, 1.0, -1.0, 1.0]), X, L), "body_T_sensor: expected a right-handed rot"),
        (lambda: line_expecting(FLOOR, A), "expected: expected a plane that cuts the scan plane, got one at 0 rad"),
        *((lambda wrong=wrong: robust(wrong), r"robust: expected None, one of .* or \(name") for wrong in NO_KERNELS),
        *((lambda wrong=wrong: robust(wrong), "robust: expected a positive finite number") for wrong in WRONG_KERNELS),
        *((lambda wrong=wrong: out_of_plane(wrong), "out_of_plane_sigmas: expected") for wrong in WRONG_SIGMAS),
        *((lambda wrong=wrong: planar_motion_factor(X, sigmas=wrong), "sigmas: expected") for wrong in WRONG_SIGMAS),
        (lambda: direction_prior(L, (0.0, 0.0, 0.0), 0.1), "direction: expected a direction, got the zero vector"),
        (lambda: direction_prior(L, (1e200, 0, 0), 0.1), "direction: expected numbers below"),
        (lambda: landmark_anchors(gtsam.Values()), "graph: expected a NonlinearFactorGraph, got Values"),
        (lambda: get_ready(PLANE), "planes: expected a sequence, got Plane"),
        (lambda: map_prior(PLANE, [L], np.eye(3)), "planes: expected a sequence, got Plane"),
        (lambda: map_prior([PLANE], L, np.eye(3)), "plane_keys: expected a sequence, got int"),
        (lambda: joint_covariance(None, [L]), "marginals: expected a Marginals, got NoneType"),
        (lambda: world_plane(None, None, L), "values: expected a Values, got NoneType"),
        (
            lambda: world_plane(WALL, None, L, anchor_key=L),
            "anchor_key: expected the key of a Pose3 or Pose2 .* got l0",
        ),
        *((lambda keys=keys: isam_covariance(gtsam.ISAM2(), WALL, keys), message) for keys, message in WRONG_KEYS),
        *((lambda keys=keys: joint_covariance(MARGINALS, keys), message) for keys, message in WRONG_KEYS),
        (lambda: isam_covariance(gtsam.ISAM2(), WALL, ("x", L)), "keys: expected a GTSAM key"),
        (lambda: isam_covariance(gtsam.ISAM2(), WALL, [X]), "keys: expected variables of isam and of values, got"),
        (lambda: isam_covariance(WALL, WALL, (L,)), "isam: expected an ISAM2, got Values"),
        (lambda: copy_graph(None), "graph: expected a NonlinearFactorGraph, got NoneType"),
        (lambda: copy_graph(gtsam.NonlinearFactorGraph(), "x"), "values: expected a Values, got str"),
        (lambda: copy_graph([]), "graph: expected a NonlinearFactorGraph, got list"),
        (lambda: isam2_parameters(threshold=0.0), "threshold: expected a positive finite number, got 0"),
        (lambda: settle({}), "isam: expected an ISAM2, got dict"),
        (lambda: settle(gtsam.ISAM2(), most=-1), "most: expected a whole number >= 0, got -1"),
        (lambda: line_factor(PLANE, np.eye(4), X, L), "line: expected a ScanLine, got Plane"),
        (lambda: line_expecting(PLANE, A), "expected: expected an OrientedPl"),
        (lambda: plane_factor(PLANE, X, X), "plane_key: expected another key than pose_key, got"),
        (lambda: plane_factor(PLANE, X, L, anchor_key=L), "plane_key: expected another key than anchor_key, got"),
        (lambda: line_factor(LINE, np.eye(4), L, L), "plane_key: expected another key than pose_key, got"),
        (lambda: odometry_factor(X, X, (1, 0, 0), np.eye(3)), "key_b: expected another key than key_a, got"),
        (lambda: odometry_factor_2d(X, X, (1, 0, 0), np.eye(3)), "key_b: expected another key than key_a, got"),
        (lambda: planar_motion_factor(X, height=np.nan), "height: expected a finite number, got nan"),
        (lambda: planar_motion_factor(X, height=[1]), r"height: expected a number, got \[1\]"),
        (lambda: with_robust(gtsam.noiseModel.Unit.Create(3), ("huber", "a"), 3), "robust: expected a number, got 'a'"),
        (lambda: distance_factor(L, A, 1.0, 0.1, anchor_a=L), "anchor_a: expected another key than plane_a, got"),
        (lambda: distance_factor(L, A, [1.0], 0.1), r"distance_m: expected a number, got \[1.0\]"),
        (lambda: parallel_factor(L, A, None), "sigma_rad: expected a number, got None"),
        (lambda: world_plane(NOTHING, None, L), "plane_key: expected the key of an OrientedPlane3 in values, got l0"),
        (lambda: parallel_factor(L, L, 0.1), "plane_b: expected another landmark than plane_a, got the same key l0"),
        (lambda: line_expecting(FLOOR, None), "expected: expected an anchor_key with it, got none"),
    ],
)
def test_one_sentence_that_names_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_a_caller_writes_into_later_changes_nothing():
    mount, at, covariance, ends = np.eye(4), np.zeros(3), np.diag([1e-6, 1e-6]), np.array([[2.0, -1.0], [2.0, 1.0]])
    beams = np.arange(2)
    line = ScanLine(0.0, 2.0, covariance, ends, beams)
    seen, facing = LineObservation(line, mount), gtsam.OrientedPlane3(-1.0, 0.0, 0.0, 2.0)
    values = values_of(x0=gtsam.Pose3(), l0=facing, a0=gtsam.OrientedPlane3(0.8, 0.6, 0.0, 1.0))
    factors = line_factor(line, mount, X, L), distance_factor(L, A, 1.0, 0.01, at=at)
    before = [factor.error(values) for factor in factors]
    mount[0, 3], at[1] = 1.0, 5.0
    for given in (covariance, ends, beams):
        given *= 100
    assert [factor.error(values) for factor in factors] == before
    assert seen.body_T_sensor[0, 3] == 0.0 and line.covariance[0, 0] == 1e-6 and line.endpoints[0, 0] == 2.0
    for kept in (line.covariance, line.endpoints, line.indices, seen.body_T_sensor):
        with pytest.raises(ValueError, match="read-only"):
            kept[...] = 0


def test_planes_made_ready_together_give_the_factors_they_give_alone():
    rng = np.random.default_rng(5)
    planes = [random_plane(rng) for _ in range(4)]
    alone = [plane_factor(copy(plane), X, L, anchor_key=A) for plane in planes]
    get_ready(planes)
    values = values_of(x0=random_pose(rng), a0=random_pose(rng), l0=gtsam.OrientedPlane3(0.6, 0.0, 0.8, 2.0))
    for one, plane in zip(alone, planes, strict=True):
        other = plane_factor(plane, X, L, anchor_key=A)
        assert one.linearize(values).equals(other.linearize(values), 0.0)
    with pytest.raises(ValueError, match="singular"):
        get_ready([planes[0], Plane._trusted(np.eye(4), np.zeros((3, 3)), 3)])
    with pytest.raises(ValueError, match="plane: expected a Plane, got int"):
        get_ready([3])  # type: ignore[list-item]


def test_keys_without_a_marginal_are_named():
    """Once ``IndexError: map::at``."""
    values, x1 = values_of(x1=gtsam.Pose3(), x2=gtsam.Pose3(), l0=gtsam.OrientedPlane3()), gtsam.symbol("x", 1)
    marginals = gtsam.Marginals(graph_of(pose_prior(x1, gtsam.Pose3(), np.eye(6))), values)
    with pytest.raises(ValueError, match="keys: expected variables of the graph that the marginals are of, got l0"):
        world_plane(values, marginals, L)
    for ask in (world_plane, lambda *a, **k: seen_plane(*a, gtsam.symbol("x", 2), **k)):
        with pytest.raises(ValueError, match=r"keys: expected variables of the graph .*l0"):
            ask(values, marginals, L, anchor_key=x1)
    with pytest.raises(ValueError, match="keys: expected variables of the graph that the marginals are of, got x2"):
        joint_covariance(marginals, [x1, gtsam.symbol("x", 2)])
    np.testing.assert_allclose(joint_covariance(marginals, [x1]), np.eye(6))


def test_a_pose3_is_taken_wherever_a_matrix_is():
    pose = random_pose(np.random.default_rng(2))
    matrix = pose.matrix()
    np.testing.assert_array_equal(Plane(pose, PLANE.covariance).frame, matrix)
    np.testing.assert_array_equal(PLANE.transform(pose).frame, PLANE.transform(matrix).frame)
    np.testing.assert_array_equal(Location.pose(pose, np.eye(6)).transform, matrix)
    np.testing.assert_array_equal(as_shape("poses", [pose, pose], (None, 4, 4)), [matrix, matrix])
    values = values_of(x0=random_pose(np.random.default_rng(3)), l0=plane_landmark(PLANE, pose))
    for with_pose, with_matrix in (
        (line_factor(LINE, pose, X, L), line_factor(LINE, matrix, X, L)),
        (pose_prior(X, pose, np.eye(6)), pose_prior(X, matrix, np.eye(6))),
    ):
        assert with_pose.error(values) == with_matrix.error(values)
