"""30 % gross outliers: the error at most doubles, and the covariance stays right."""

from functools import cache

import numpy as np
import pytest

from spplanes import fit_plane
from tests.spplanes.fitting.fit_scenes import loss, run, scenes
from tests.statistics import assert_mean_in_band

RUNS = 600  # a mean NEES of 3 to 3 %, of 2000 it was to 2 %
SCENES = scenes()


def around(points, scene, rng):
    """Scattered a metre about where they belong."""
    return points + rng.uniform(-1.0, 1.0, points.shape)


def behind(points, scene, rng):
    """Through a window: all on one side."""
    return points - scene.frame[:3, 2] * rng.uniform(0.2, 1.5, (len(points), 1))


def parallel(points, scene, rng):
    """Another wall, half a metre off."""
    return points + 0.5 * scene.frame[:3, 2]


def everywhere(points, scene, rng):
    """Clutter in 200 m around: some lie far out along the plane, where they have all the leverage."""
    return rng.uniform(-100.0, 100.0, points.shape)


def contaminated(kind, rng, share=0.3):
    def task(points, scene):
        spoilt = rng.choice(len(points), int(share * len(points)), replace=False)
        points = points.copy()
        points[spoilt] = kind(points[spoilt], scene, rng)
        return robust(points, scene)

    return task


def robust(points, scene):
    return fit_plane(points, scene.covariances, viewpoint=scene.sensor, robust="tukey", **scene.shared)


@cache
def clean(name, seed):
    """Errors of the fit that is not robust, without outliers."""
    return run(SCENES[name], lambda p, s: fit_plane(p, s.covariances, viewpoint=s.sensor), RUNS, seed)[1]


@pytest.mark.parametrize("kind", [around, behind, parallel, everywhere])
@pytest.mark.parametrize("name", ["frontal wall", "strip 10 m x 0.1 m", "noise along the beam"])
def test_error_and_covariance_with_outliers(name, kind):
    scene = SCENES[name]
    values, local, _ = run(scene, contaminated(kind, np.random.default_rng(1)), RUNS, seed=1)
    assert_mean_in_band(values, 3)
    assert loss(local, scene) < 2.0 * loss(clean(name, 1), scene)


@pytest.mark.parametrize("name", ["frontal wall", "30 m away", "wall at 75 deg", "12 points"])
def test_clean_points_lose_little(name):
    """Tukey's constant is set for 95 % efficiency, an error of 1 / sqrt(0.95) = 1.026."""
    scene = SCENES[name]
    values, local, _ = run(scene, robust, RUNS, seed=2)
    assert_mean_in_band(values, 3)
    assert loss(local, scene) < 1.06 * loss(clean(name, 2), scene)


def test_counts_only_inliers():
    scene = SCENES["frontal wall"]
    points = scene.sample(np.random.default_rng(3))
    points[::5] -= 0.5 * scene.frame[:3, 2]
    plane = robust(points, scene)
    assert plane.n_points == 240
    assert 150 < plane.chi2 < 330


def test_outliers_among_scans_with_pose_errors():
    scene = SCENES["20 scans, shared poses"]
    values, local, _ = run(scene, contaminated(behind, np.random.default_rng(5), share=0.2), 400, seed=5)
    assert_mean_in_band(values, 3)
    assert loss(local, scene) < 2.0


def test_nothing_but_clutter_is_refused_or_very_uncertain():
    """No crash and no false certainty from points in no plane at all."""
    for seed in range(20):
        points = np.random.default_rng(seed).uniform(-5, 5, (30, 3))
        try:
            plane = fit_plane(points, sigma=0.001, robust="tukey")
        except ValueError as error:
            assert "points: expected" in str(error)
        else:
            assert plane.n_points <= 10
