"""The factor on the odometry's sigma: found where scans tell it, one where it is as stated, slips left out."""

import numpy as np
import pytest

from slam.config import CoastingConfig
from slam.frontend.odometry import Motion
from slam.geometry.frames import planar_transform
from slam.tracking.odometry_scale import OdometryScale, scaled
from slam.tracking.prediction import coast
from tests.slam.short_drives import mapped_beginning

STEP = Motion(
    planar_transform(0.4, 0.02, 0.3),
    np.array([[2.0e-4, 2e-5, 0.0], [2e-5, 6e-5, 1e-5], [0.0, 1e-5, 5e-5]]),
    (1e-3, 1e-3, 1e-3),
)
SPATIAL = Motion(STEP.a_T_b, np.diag([2e-4, 1e-4, 1e-4, 5e-5, 4e-5, 4e-5]), (1e-3, 1e-3, 1e-3))
SCAN = np.diag(np.repeat([0.002, 0.0005], 3) ** 2)
GUESS = coast(None, 0.0, 0.5, CoastingConfig())


def after(rng: np.random.Generator, motion: Motion, times: float, steps: int, *, slips: float = 0.0) -> float:
    """The factor after so many steps that err so many times as much as stated, a share of them at random."""
    scale, covariance, wide = OdometryScale(), scaled(motion, times).spatial + SCAN, GUESS.spatial
    for _ in range(steps):
        off = rng.multivariate_normal(np.zeros(6), wide if rng.random() < slips else covariance)
        scale.learn(motion, off, SCAN, GUESS)
    return scale.factor


@pytest.mark.parametrize("motion", [STEP, SPATIAL], ids=["planar", "spatial"])
@pytest.mark.parametrize("times", [1.0, 2.0, 3.0, 6.0])
def test_the_factor_is_found_in_sixty_steps(motion: Motion, times: float) -> None:
    rng = np.random.default_rng(1)
    # 60 steps of at least 3 errors tell a factor to 1 / sqrt(360); none below one is told from one. The mean of 16 is
    # known to 1.3 %, a third of what it may be off, their scatter to 18 %.
    found = np.array([after(rng, motion, times, 60) for _ in range(16)])
    assert np.mean(found) == pytest.approx(times, rel=0.04) and np.std(found / times) < 1.5 / np.sqrt(360)


def test_three_steps_tell_an_odometry_three_times_worse_than_stated_from_one_that_is_not() -> None:
    rng = np.random.default_rng(2)
    worse, honest = (np.array([after(rng, STEP, times, 3) for _ in range(100)]) for times in (3.0, 1.0))
    assert np.quantile(worse, 0.1) > 1.7 > np.quantile(honest, 0.9) and OdometryScale().factor == 1.0


def test_slips_are_left_out_and_a_scan_that_knows_nothing_tells_nothing() -> None:
    rng = np.random.default_rng(3)
    assert np.mean([after(rng, STEP, 1.0, 60, slips=0.15) for _ in range(20)]) < 1.1
    assert np.mean([after(rng, STEP, 3.0, 60, slips=0.15) for _ in range(20)]) == pytest.approx(3.0, rel=0.1)
    off, blind, sharp = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]), OdometryScale(), OdometryScale()
    for _ in range(30):
        blind.learn(STEP, off, SCAN + np.diag([100.0, 0.0, 0.0, 0.0, 0.0, 0.0]), GUESS)
        sharp.learn(STEP, 0.2 * off, SCAN, GUESS)
    assert blind.factor < 1.1 < 3.0 < sharp.factor  # nothing was off where the scans tell


@pytest.mark.parametrize(
    ("off_m", "slips", "least", "most"),
    [(0.1, 2, 1.0, 1.3), (0.05, 1, 1.25, 1.9)],
    ids=["two slips, 5.5 if one step in a hundred were one", "maybe one, 1.1 if every second were, 2.4 if none"],
)
def test_one_step_in_ten_may_be_a_slip_among_few(off_m: float, slips: int, least: float, most: float) -> None:
    """Many steps as stated outweigh a slip whatever its share; after three it is that share that does."""
    scale = OdometryScale()
    for _ in range(3):
        scale.learn(STEP, np.array([0.01, 0.006, 0.0, 0.005, 0.0, 0.0]), SCAN, GUESS)  # each about one sigma
    for _ in range(slips):
        scale.learn(STEP, off_m * np.array([1.0, -0.5, 0.0, 1.0, 0.0, 0.0]), SCAN, GUESS)
    assert least <= scale.factor < most


def test_wheels_that_get_better_are_believed_again() -> None:
    rng, scale = np.random.default_rng(4), OdometryScale()
    for times in np.repeat([5.0, 1.0], 60):
        scale.learn(STEP, rng.multivariate_normal(np.zeros(6), scaled(STEP, times).spatial + SCAN), SCAN, GUESS)
    assert scale.factor < 1.15


def test_a_scaled_motion_is_as_much_wider_and_leads_to_the_same_place() -> None:
    wider = scaled(STEP, 3.0)
    assert scaled(STEP, 1.0) is STEP and wider.a_T_b is STEP.a_T_b
    np.testing.assert_allclose(wider.covariance, 9.0 * STEP.covariance)


def test_a_lidar_with_odometry_three_times_worse_than_stated_maps_as_one_without_any() -> None:
    """Taken at its word, the poses were 7 to 30 cm off and half the planes in the map twice."""
    run, off = mapped_beginning("sloped/lidar32/worse3", 170024, 10)
    assert np.abs(off[:, :3, 3]).max() < 0.005 and 2.0 < run.slam.odometry_record.steps[-1].scale < 5.0
