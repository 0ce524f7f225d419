"""Factors mean what their covariance says: the error of measurements drawn from it is chi-squared, at every normal.

What is drawn has a chi2 of its own, so the factors' error is compared with that of each draw and not with its mean: the
difference does not scatter as chi2 does, and few draws tell a covariance that is wrong by a hundredth.
"""

import gtsam
import numpy as np
import pytest

from factors import line_factor, plane_factors
from spplanes import Plane
from tests.factors.factor_scenes import (
    TIED_NORMALS,
    A,
    L,
    X,
    frame_of,
    make_line,
    perturbed,
    random_covariance,
    random_normals,
    random_pose,
    values_of,
)
from tests.statistics import mean_nees_band

SAMPLES = 20
N_RANDOM = 200  # with the tied ones: 218 normals


def normals() -> np.ndarray:
    return np.vstack([TIED_NORMALS, random_normals(np.random.default_rng(11), N_RANDOM)])


def measured_planes(rng: np.random.Generator, true_frame: np.ndarray) -> tuple[list[Plane], float]:
    """Measurements of one plane: their perturbation to the truth is drawn from the covariance they carry; mean chi2."""
    sigmas = np.array([0.005, np.radians(1.0) / 50.0 ** rng.random(), np.radians(1.0)])
    if rng.random() < 0.5:
        sigmas = sigmas[[0, 2, 1]]
    covariance = random_covariance(rng, sigmas)
    drawn = rng.normal(size=(SAMPLES, 3))
    perturbations = drawn @ np.linalg.cholesky(covariance).T
    measured = true_frame @ np.linalg.inv(np.stack([perturbed(np.eye(4), p) for p in perturbations]))
    return [Plane(frame=frame, covariance=covariance) for frame in measured], float((drawn**2).sum() / SAMPLES)


def nis(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
    return 2.0 * graph.error(values) / graph.size()


def mean_nis_at(form: str, index: int, normal: np.ndarray) -> float:
    """Mean NIS of plane measurements with ``normal`` in the body's frame, at the truth, over what was drawn."""
    rng = np.random.default_rng([5, index])
    frame = frame_of(normal, rng.uniform(-3, 3, 3), rng.uniform(0, 2 * np.pi))
    (planes, drawn), pose, anchor = measured_planes(rng, frame), random_pose(rng), random_pose(rng)
    seen = gtsam.OrientedPlane3(np.array([*frame[:3, 2], -frame[:3, 2] @ frame[:3, 3]]))
    in_world = seen.transform(pose.inverse())
    at = {"anchored": in_world.transform(anchor), "own anchor": seen}.get(form, in_world)
    values = values_of(x0=pose, a0=anchor, l0=at)
    anchor_keys = {"anchored": [A] * SAMPLES, "own anchor": [X] * SAMPLES}.get(form)
    return nis(plane_factors(planes, [X] * SAMPLES, [L] * SAMPLES, anchor_keys), values) / drawn


@pytest.mark.parametrize(
    ("form", "each", "mean"), [("anchored", 0.15, 0.01), ("world", 0.01, 0.001), ("own anchor", 0.01, 0.001)]
)
def test_plane_factor_at_every_normal(form: str, each: float, mean: float):
    """Of every normal and on average; an anchored one is corrected beyond first order, by the sample."""
    ratios = np.array([mean_nis_at(form, i, normal) for i, normal in enumerate(normals())])
    np.testing.assert_allclose(ratios, 1.0, atol=each)
    assert ratios.mean() == pytest.approx(1.0, abs=mean)


def wall_cut(rng: np.random.Generator, body_T_sensor: gtsam.Pose3, tilts_deg: tuple, distances_m: tuple):
    """A pose, an anchor, a wall in the world, and (alpha, rho) of the line in which it cuts the scan plane."""
    pose, anchor = random_pose(rng), random_pose(rng)
    in_plane, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*tilts_deg))
    normal = [np.cos(tilt) * np.cos(in_plane), np.cos(tilt) * np.sin(in_plane), np.sin(tilt)]
    world_T_sensor = pose.compose(body_T_sensor)
    plane = gtsam.OrientedPlane3(np.array([*normal, -rng.uniform(*distances_m)])).transform(world_T_sensor.inverse())
    a, b, _, minus_d = plane.transform(world_T_sensor).planeCoefficients()
    alpha, rho = np.arctan2(b, a), -minus_d / np.hypot(a, b)
    return pose, anchor, plane, (alpha, rho) if rho >= 0.0 else (alpha + np.pi, -rho)


MOUNTS = {
    "horizontal": gtsam.Pose3(gtsam.Rot3(), np.array([0.2, 0.1, 0.3])),
    "vertical": gtsam.Pose3(gtsam.Rot3(np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])), np.array([0.0, 0.1, 0.5])),
    "tilted": gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, 0.5, -0.7), np.array([0.3, -0.2, 0.4])),
}


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("mount", MOUNTS)
def test_line_factor_on_walls_of_every_tilt(mount, anchored):
    """Planes at 15 to 90 degrees to the scan plane; alpha and rho correlated."""
    ratios, body_T_sensor = [], MOUNTS[mount]
    for i in range(40):
        rng = np.random.default_rng([9, i])
        pose, anchor, plane, (alpha, rho) = wall_cut(rng, body_T_sensor, (0, 75), (1, 5))
        r = rng.uniform(-0.9, 0.9) * np.radians(0.5) * 0.01
        covariance = np.array([[np.radians(0.5) ** 2, r], [r, 0.01**2]])
        drawn = rng.normal(size=(SAMPLES, 2))
        graph, key = gtsam.NonlinearFactorGraph(), A if anchored else None
        for da, dr in drawn @ np.linalg.cholesky(covariance).T:
            line = make_line(alpha + da, rho + dr, covariance)
            graph.push_back(line_factor(line, body_T_sensor.matrix(), X, L, anchor_key=key))
        values = values_of(x0=pose, a0=anchor, l0=plane.transform(anchor) if anchored else plane)
        ratios.append(nis(graph, values) / ((drawn**2).sum() / SAMPLES))
    np.testing.assert_allclose(ratios, 1.0, atol=0.06)  # lines are not quite linear in the wall
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("mount", MOUNTS)
def test_native_line_factor_is_the_compiled_one_where_the_tilt_is_known(mount):
    """Same information, same errors; 2 degrees of freedom, and exact distances where the tilt was expected wrongly."""
    body_T_sensor = MOUNTS[mount]
    for i in range(100):
        rng = np.random.default_rng([13, i])
        pose, anchor, plane, polar = wall_cut(rng, body_T_sensor, (-75, 75), (0, 5))
        line = make_line(*polar, random_covariance(rng, np.array([0.01, 0.02])))
        keys = (line, body_T_sensor.matrix(), X, L)
        native = line_factor(*keys, anchor_key=A, expected=plane.transform(pose))
        compiled = line_factor(*keys, anchor_key=A)
        assert type(native).__name__ == "LocalOrientedPlane3Factor"
        values = values_of(x0=pose, a0=anchor, l0=plane.transform(anchor))
        assert native.error(values) < 1e-15
        a, b = (factor.linearize(values).jacobian()[0] for factor in (native, compiled))
        np.testing.assert_allclose(a.T @ a, b.T @ b, rtol=1e-6, atol=1e-6 * np.abs(b.T @ b).max())
        off = values_of(x0=pose.retract(1e-3 * rng.normal(size=6)), a0=anchor, l0=plane.transform(anchor))
        assert native.error(off) == pytest.approx(compiled.error(off), rel=0.05, abs=1e-6)
        wrong = line_factor(*keys, anchor_key=A, expected=plane.transform(pose).retract(np.array([0.2, -0.1, 0.0])))
        assert wrong.error(values) < 1e-15


def test_native_line_factor_seen_along_a_line_through_the_origin():
    """Wall through the body's own origin: the two points and the origin are in line."""
    line = make_line(0.3, 0.0, np.diag([0.01, 0.02]))
    wall = gtsam.OrientedPlane3(np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0]))
    factor = line_factor(line, np.eye(4), X, L, anchor_key=A, expected=wall)
    values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3(), l0=wall)
    assert factor.error(values) < 1e-15
    values.update(X, gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.5])))
    compiled = line_factor(line, np.eye(4), X, L, anchor_key=A)
    assert factor.error(values) == pytest.approx(compiled.error(values))
    assert factor.error(values) > 1e-3


@pytest.mark.parametrize("tilt_deg", [0.3, 1.0, 1.6, 3.0])
def test_second_order_of_far_patches_is_corrected(tilt_deg):
    """A patch 8 m away whose tilt is uncertain: honest NIS, and no bias left in the mean of many observations.

    Neglected, at 1.6 deg the distance would be 6.2 mm, 1.2 sigmas of z, short on average.
    """
    rng = np.random.default_rng(21)
    frame = frame_of(np.array([0.0, 0.0, 1.0]), np.array([1.0, -2.0, 8.0]), 0.3)
    covariance = np.diag([0.005, np.radians(tilt_deg), np.radians(tilt_deg)]) ** 2
    p = rng.normal(size=(3000, 3)) * np.sqrt(np.diag(covariance))
    planes = [Plane(frame @ np.linalg.inv(perturbed(np.eye(4), each)), covariance) for each in p]
    n = len(planes)
    graph = plane_factors(planes, [X] * n, [L] * n, [A] * n)
    values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3(), l0=gtsam.OrientedPlane3(0.0, 0.0, 1.0, -8.0))
    low, high = mean_nees_band(n, 3, 0.999)
    assert low < nis(graph, values) < high
    for key in (X, A):
        graph.addPriorPose3(key, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-9))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atOrientedPlane3(L).planeCoefficients()
    shift = -found[3] - found[:3] @ frame[:3, 3]
    z_sigma = np.hypot(0.005, 8.0 * np.radians(tilt_deg) ** 2)
    assert abs(shift) < 4.0 * z_sigma / np.sqrt(n), shift
