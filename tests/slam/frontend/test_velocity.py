"""The velocity between stamped scans: NIS of predictions, what is forgotten, and how well a clock's noise is found."""

import numpy as np
import pytest

from slam.config import CoastingConfig
from slam.frontend.laser_odometry.velocity import VelocityFilter, stamp_sigma

RULES = CoastingConfig()
USUAL = np.array((RULES.speed_sigma_m_per_s, RULES.speed_sigma_m_per_s, RULES.turn_sigma_rad_per_s))
ACCELERATION, TURN_CHANGE = RULES.acceleration_sigma_m_per_s2, RULES.turn_change_sigma_rad_per_s2
CHANGE = np.array((ACCELERATION, ACCELERATION, TURN_CHANGE))
PERIOD_S, STEP_SIGMA = 0.2, 0.01


def nis_per_dof(stamps_err_s: float, seed: int, n_steps: int = 2000) -> float:
    """Mean NIS per degree of freedom of predicted steps of a body whose velocity is the process that is assumed."""
    rng, kept = np.random.default_rng(seed), USUAL**2 / (USUAL**2 + (CHANGE * PERIOD_S) ** 2)
    velocity = USUAL * rng.standard_normal(3)
    times = np.sort(PERIOD_S * np.arange(n_steps + 1) + stamps_err_s * rng.standard_normal(n_steps + 1))
    tracked, noise, total = VelocityFilter(RULES, stamps_err_s), STEP_SIGMA**2 * np.eye(3), 0.0
    for seconds in np.diff(times):
        velocity = np.sqrt(kept) * velocity + np.sqrt(1.0 - kept) * USUAL * rng.standard_normal(3)
        moved = velocity * PERIOD_S + STEP_SIGMA * rng.standard_normal(3)
        expected, covariance = tracked.ahead(seconds)
        total += (moved - expected) @ np.linalg.solve(covariance + noise, moved - expected)
        tracked.learn(seconds, moved, noise)
    return float(total / (3 * n_steps))


@pytest.mark.parametrize("stamps_err_s, least", [(0.0, 0.93), (0.02, 0.85), (0.05, 0.75)])
def test_predictions_are_as_far_off_as_they_say(stamps_err_s: float, least: float):
    """By design a little wide with an uncertain clock: an interval and the next share the stamp between them."""
    for seed in range(3):
        assert least < nis_per_dof(stamps_err_s, seed) < 1.07


def steady_drive(tracked: VelocityFilter, rng: np.random.Generator, stops: float, open_from: int) -> np.ndarray:
    """Squared errors over what is said of them, of steps along the way of a body that now and then starts or stops.

    Each step is matched to what was expected of it, as scans are; from a number on returns say nothing along the way.
    """
    velocity, said = np.zeros(3), []
    for number in range(400):
        if rng.random() < stops:
            velocity = np.array((0.0 if velocity[0] > 0.2 else 0.5, 0.0, 0.0))
        velocity = velocity + 0.01 * rng.standard_normal(3)
        true = velocity * PERIOD_S
        noise = np.array((STEP_SIGMA if number < open_from else 30.0, STEP_SIGMA, STEP_SIGMA))
        seen = true + np.minimum(noise, 1.0) * rng.standard_normal(3)
        ways = [tracked.usually(PERIOD_S)[:2], tracked.ahead(PERIOD_S)]
        misfits = [(seen - step) @ np.linalg.solve(cov + np.diag(noise**2), seen - step) for step, cov in ways]
        step, cov = ways[0] if misfits[0] < 16.3 else ways[1]
        moved = step + cov @ np.linalg.solve(cov + np.diag(noise**2), seen - step)
        without = tracked.learn_unmeasured(PERIOD_S, moved, np.diag(noise**2), (step, cov))
        if number >= open_from:
            said.append((moved[0] - true[0]) ** 2 / without[0, 0])
    return np.array(said)


def test_who_keeps_its_velocity_is_expected_to_and_who_stops_is_not_lost():
    """A robot that changes its velocity by 1 cm/s a step, where any body may by 40 cm/s, and stops once in 20 s."""
    rng, widths, off = np.random.default_rng(5), [], []
    for _ in range(6):
        tracked = VelocityFilter(RULES)
        steady_drive(tracked, rng, 0.01, 400)
        usual, any_body = tracked.usually(PERIOD_S)[1], tracked.ahead(PERIOD_S)[1]
        widths.append(np.sqrt(np.diag(usual) / np.diag(any_body)))
        off.append(tracked.ahead(1.0)[0][0])
    assert np.all(np.median(widths, axis=0) < 0.25)
    assert np.all((np.abs(off) < 0.15) | (np.abs(np.subtract(off, 0.5)) < 0.15))  # it knows whether it stands


def test_the_first_steps_along_what_nobody_sees_are_as_far_off_as_is_said():
    """A second of an open way after a minute that was told; the learnt width, and not that of any body, is said."""
    rng, said = np.random.default_rng(6), []
    for _ in range(60):
        said.append(steady_drive(VelocityFilter(RULES), rng, 0.01, 300)[:5].mean())
    assert 0.1 < np.mean(said) < 1.5 and np.median(said) > 0.03  # as wide as any body: 0.001


def test_a_velocity_is_forgotten_in_the_end():
    tracked = VelocityFilter(RULES)
    tracked.learn(0.1, np.array((0.05, 0.0, 0.02)), 1e-8 * np.eye(3))
    soon, spread = tracked.ahead(0.1)
    assert soon == pytest.approx((0.05, 0.0, 0.02), rel=0.02)
    assert np.sqrt(spread[0, 0]) == pytest.approx(RULES.acceleration_sigma_m_per_s2 * 0.1**2, rel=0.02)
    late, spread = tracked.ahead(100.0)  # any velocity that bodies have
    assert np.abs(late).max() < 0.02 * 0.5 * 100.0
    assert np.sqrt(np.diag(spread)) == pytest.approx(100.0 * USUAL, rel=0.01)


def test_a_step_that_the_clock_gives_no_time_says_nothing_of_the_velocity():
    """Two scans of one burst, 1 ms apart by their stamps: no body turns by 60 rad/s."""
    tracked = VelocityFilter(RULES, 0.1)
    for _ in range(20):
        tracked.learn(0.2, np.array((0.0, 0.0, 0.06)), 1e-6 * np.eye(3))
    before, _ = tracked.ahead(0.2)
    tracked.learn(0.001, np.array((0.0, 0.0, 0.06)), 1e-6 * np.eye(3))
    after, _ = tracked.ahead(0.2)
    assert before[2] == pytest.approx(0.06, abs=0.01) and after == pytest.approx(before, abs=0.01)


def test_noise_of_a_clock_is_found_in_its_stamps():
    rng, steady = np.random.default_rng(3), 0.2 * np.arange(2000)

    def found(seconds: np.ndarray) -> float:
        return stamp_sigma((1e9 * seconds).astype(np.int64).tolist())

    assert found(steady) < 1e-6
    assert found(np.sort(steady + 0.03 * rng.standard_normal(2000))) == pytest.approx(0.03, rel=0.06)
    with_a_pause = steady + 0.03 * rng.standard_normal(2000) + 500.0 * (steady > 200.0)
    assert found(np.sort(with_a_pause)) == pytest.approx(0.03, rel=0.15)
    assert found(steady[rng.random(2000) < 0.8]) < 0.03  # a fifth left out
    assert found(steady[:2]) == 0.0
