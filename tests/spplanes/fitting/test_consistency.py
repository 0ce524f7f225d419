"""Is the covariance right (NEES), and is the estimate as good as it can be (Cramer-Rao)? On nine scenes, seeded."""

from dataclasses import replace

import numpy as np
import pytest

from spplanes import fit_plane
from tests.spplanes.fitting.fit_scenes import Scene, error_of, linear_run, loss, plane_frame, run, scenes
from tests.statistics import assert_mean_in_band, nees

RUNS = 2000
#: Of what is compared with the linear estimate on the same noise. The difference of the mean NEES scatters by 0.2 to
#: 0.6 % then: a covariance that is wrong by 4 % is told from a right one by 3 to 10 of these.
FEW = 200
SCENES = scenes()


def fit(method="ml", **options):
    def task(points, scene):
        return fit_plane(points, scene.covariances, method=method, viewpoint=scene.sensor, **scene.shared, **options)

    return task


@pytest.mark.parametrize("name", SCENES)
def test_ml_is_consistent_and_efficient(name):
    """NEES within 2 % of that of the best linear estimate on the same noise, which is chi2; error within 0.5 %."""
    scene = SCENES[name]
    values, local, _ = run(scene, fit(), FEW, seed=1)
    best = linear_run(scene, FEW, seed=1)
    assert_mean_in_band(best.chi2, 3)
    assert values.mean() == pytest.approx(best.chi2.mean(), rel=0.02)
    if len(scene.true_points) >= 50:
        assert loss(local, scene) < 1.005 * loss(best.local, scene)


@pytest.mark.parametrize("name", ["frontal wall", "12 points"])
def test_sp_is_consistent_where_noise_is_not_oblique(name):
    values, _, _ = run(SCENES[name], fit("sp"), RUNS, seed=2)
    assert_mean_in_band(values, 3)


def test_covariances_taken_at_the_measured_points():
    """As a user does it: the sensor model is evaluated where the points were seen, not where they are."""
    scene = SCENES["noise growing with range"]
    values, _, _ = run(scene, lambda points, s: fit_plane(points, s.model(points), viewpoint=s.sensor), RUNS, seed=4)
    assert_mean_in_band(values, 3)


@pytest.mark.parametrize("length", [2.0, 0.08])
def test_narrow_patch_in_isotropic_noise(length):
    """A strip, or a square, hardly wider than the noise is deep: that noise must be taken out of its width."""
    rng, frame = np.random.default_rng(6), plane_frame(3.0, 30.0)
    local = np.column_stack([0.5 * length * rng.uniform(-1, 1, 400), rng.uniform(-0.03, 0.03, 400)])
    scene = of_places(frame, local, np.full(400, 0.01))
    values, _, covariances = run(scene, fit(), RUNS, seed=5)
    assert_mean_in_band(values, 3)
    assert np.mean(covariances[:, 2, 2]) > 1.1 * scene.crb()[2, 2]


def of_places(frame, local, sigma):
    """Points at places (N, 2) of a plane, with isotropic noise (N,)."""
    points = local @ frame[:3, :2].T + frame[:3, 3]
    return Scene(points, sigma[:, None, None] ** 2 * np.eye(3), frame, np.zeros(3))


def lopsided():
    """Noise 20 times as strong in one corner: with weights that do not match it, all three errors are correlated."""
    u = np.random.default_rng(7).uniform(-1, 1, (200, 2))
    return of_places(plane_frame(3.0, 25.0), u * (1.5, 1.0), 0.01 * 4.5 ** (0.5 * (u[:, 0] + u[:, 1])))


def lopsided_poses():
    """Scans of one side of a wall only, whose pose errors have an origin far beside it."""
    rng = np.random.default_rng(8)
    root = 0.01 * rng.normal(size=(20, 6, 6)) + 0.02 * rng.normal(size=(1, 6, 6))
    poses = root @ root.transpose(0, 2, 1)
    poses[10:] *= 25.0
    return replace(SCENES["20 scans, shared poses"], pose_covariances=0.001 * poses)


@pytest.mark.parametrize(
    ("make", "method", "runs"), [(lopsided, "sp", RUNS), (lopsided_poses, "sp", FEW), (lopsided_poses, "ml", FEW)]
)
def test_signs_of_the_correlations(make, method, runs):
    """Each pair of signs flipped moves the mean NEES far out of the band.

    Weights that ignore the noise are as wrong as noise in one corner makes them, and no linear estimate is near then.
    """
    scene = make()
    errors, covariances, rng = [], [], np.random.default_rng(9)
    for _ in range(runs):
        plane = fit(method)(scene.sample(rng), scene)
        errors.append(error_of(plane.frame, scene.frame))
        covariances.append(plane.covariance)
    errors, covariances = np.array(errors), np.array(covariances)
    values = nees(errors, covariances)
    if make is lopsided:
        assert_mean_in_band(values, 3)
    else:
        weights = 1.0 / np.trace(scene.covariances, axis1=1, axis2=2) if method == "sp" else None
        assert values.mean() == pytest.approx(linear_run(scene, runs, 9, weights).chi2.mean(), rel=0.03)
    for kept in range(3):
        signs = np.where(np.arange(3) == kept, -1.0, 1.0)
        assert nees(errors * signs, covariances).mean() > 3.6
