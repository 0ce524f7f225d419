"""What is expected of a motion that nobody measured: likelihoods, and how it is learnt, by what was drawn."""

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from slam.frontend.odometry import Motion
from slam.frontend.steadiness import Usual
from slam.geometry.frames import planar_transform
from slam.registration.motion_prior import MotionPrior, VelocityPrior
from slam.registration.surface_registration import WEAK_PRIOR, Expected

#: Of the change of any body's velocity.
CHANGE = np.repeat([0.5, 0.35], 3) ** 2
#: Of the velocity before.
BEFORE = np.diag(np.repeat([0.02, 0.01], 3) ** 2)
#: It starts where it is known to.
SURE = np.zeros(6)


def coasting(before: np.ndarray = BEFORE) -> Motion:
    """A motion by constant velocity."""
    return Motion(np.eye(4), before + np.diag(CHANGE), (0.01, 0.03, 0.03))


def learnt_from(offs: np.ndarray) -> MotionPrior:
    """After steps that were so far off, (N, 6), and well seen."""
    prior = VelocityPrior()
    for off in offs:
        prior.learn(prior.prior(coasting(), CHANGE, SURE), off)
    return prior.prior(coasting(), CHANGE, SURE)


def drawn(rng: np.random.Generator, shares: np.ndarray, rate: float, steps: int) -> np.ndarray:
    """Steps (N, 6) off by so much of what any body may be, and by all of it at this rate."""
    wide = np.where(rng.random((steps, 6)) < rate, 1.0, shares)
    return rng.standard_t(3.0, (steps, 6)) * np.sqrt(wide**2 * CHANGE + 0.63 * np.diag(BEFORE))


def test_how_a_body_moves_is_learnt_axis_by_axis() -> None:
    shares, rng = np.array([0.05, 0.1, 0.4, 0.05, 0.2, 0.08]), np.random.default_rng(4)
    found = np.array([learnt_from(drawn(rng, shares, 0.05, 60)).usual.shares for _ in range(12)])
    assert np.exp(np.log(found).mean(axis=0)) == pytest.approx(shares, rel=0.3)


def test_turns_are_rare_steps_and_not_a_wider_body() -> None:
    """Straight on, but for every tenth step: the log-likelihood of a turn is that of its rate, not of 40 sigmas."""
    offs = np.random.default_rng(5).standard_normal((60, 6)) * 0.03 * np.sqrt(CHANGE)
    offs[::10, 5] = 0.4
    learnt = learnt_from(offs)
    assert learnt.usual.shares[5] < 0.1 and 0.04 < learnt.usual.rates[5] < 0.25 and learnt.usual.rates[0] < 0.03
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.4])
    assert -8.0 < learnt.log_likelihood(turn) < -3.0
    assert learnt.log_likelihood(turn[::-1]) < learnt.log_likelihood(turn) - 1.0  # along the first it never did


def test_densities_are_densities() -> None:
    """Against the mixture of two of scipy's t, and 1 in sum."""
    learnt = MotionPrior(coasting(), CHANGE, Usual(np.full(6, 0.1), np.full(6, 0.05)), SURE)
    off, place = np.array([0.1, -0.3, 0.02, 0.2, 0.0, -0.5]), np.diag(np.full(6, 0.03**2))
    known = 0.63 * np.diag(BEFORE + place)  # of a t like that normal error
    mixed = 0.95 * stats.t.pdf(off, 3, scale=np.sqrt(0.01 * CHANGE + known))
    mixed += 0.05 * stats.t.pdf(off, 3, scale=np.sqrt(CHANGE + known))
    normal = -0.5 * np.log(2.0 * np.pi)
    assert learnt.log_density(off, place) + normal == pytest.approx(np.log(mixed))

    def density(x: float) -> float:
        return float(np.exp(learnt.log_density(np.full(6, x))[0] + normal))

    assert quad(density, -60.0, 60.0, points=[0.0], limit=400)[0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_motion_is_as_wide_as_its_deviations(share: float) -> None:
    """Second moments of what is drawn from the mixture."""
    rng, shares, wide = np.random.default_rng(6), np.full(6, share), np.sqrt(CHANGE)
    offs = rng.standard_t(3.0, (200_000, 6)) * share * wide
    rare = rng.random(offs.shape) < 0.05
    offs[rare] = (rng.standard_normal(offs.shape) * wide)[rare]
    learnt = MotionPrior(coasting(), CHANGE, Usual(shares, np.full(6, 0.05)), SURE).learnt()
    stated = np.diag(learnt.covariance) - np.diag(BEFORE)
    assert stated == pytest.approx((offs**2).mean(axis=0), rel=0.15)


def test_a_scan_tells_whether_a_step_is_a_rare_one() -> None:
    learnt = MotionPrior(coasting(), CHANGE, Usual(np.full(6, 0.03), np.full(6, 0.05)), SURE)
    place = np.diag(np.full(6, 0.01**2))
    kept, turned, blind = (
        learnt.learnt(turn * np.eye(6)[5], covariance).covariance[5, 5]
        for turn, covariance in ((0.0, place), (0.4, place), (0.0, np.diag(np.full(6, 3.0**2))))
    )
    assert kept < 0.05 * CHANGE[5] and turned == pytest.approx(CHANGE[5] + BEFORE[5, 5], rel=0.05)
    assert blind == pytest.approx(np.diag(learnt.learnt().covariance)[5], rel=0.05)  # nothing seen, nothing told


def test_a_body_off_by_what_nobody_saw_of_it_made_no_rare_step() -> None:
    """Four tenths off are no turn where it may have drifted by three; where it has not, they are."""
    usual, off = Usual(np.full(6, 0.03), np.full(6, 0.05)), np.full(6, 0.4)
    place, drifted = np.diag(np.full(6, 0.01**2)), np.full(6, 0.3**2)
    seen, unseen = (MotionPrior(coasting(), CHANGE, usual, one).learnt(off, place) for one in (SURE, drifted))
    assert np.all(np.diag(seen.covariance) > 0.9 * CHANGE)
    assert np.all(np.diag(unseen.covariance) < 0.3 * CHANGE)


def test_where_nothing_is_seen_nothing_is_learnt() -> None:
    """A body that is where it was expected because nobody saw it does not move the more steadily for that."""
    prior, fresh = VelocityPrior(), VelocityPrior().prior(coasting(), CHANGE, SURE)
    for _ in range(30):
        expected = prior.prior(coasting(), CHANGE, SURE)
        used = expected.learnt()
        known = used.covariance.copy()
        known[1:, 1:] = np.diag(np.full(5, 0.005**2))
        prior.learn(expected, np.zeros(6), used, known)
    learnt = prior.prior(coasting(), CHANGE, SURE)
    assert learnt.usual.shares[0] == fresh.usual.shares[0]
    assert np.all(learnt.usual.shares[1:] < 0.5 * fresh.usual.shares[1:])


@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.3])
def test_estimates_drawn_to_what_is_learnt_do_not_make_it_ever_smaller(sigma: float) -> None:
    """Steps of a tenth, seen by scans of some noise, the largest six times theirs: more is said of these."""
    rng, found = np.random.default_rng(7), []
    for _ in range(8):
        prior = VelocityPrior()
        for _ in range(60):
            expected = prior.prior(coasting(1e-6 * np.eye(6)), CHANGE, SURE)
            used = expected.learnt()
            wide, truth = np.diag(used.covariance), 0.1 * np.sqrt(CHANGE) * rng.standard_normal(6)
            known = 1.0 / (1.0 / wide + 1.0 / sigma**2)
            prior.learn(expected, known * (truth + sigma * rng.standard_normal(6)) / sigma**2, used, np.diag(known))
        found.append(prior.prior(coasting(), CHANGE, SURE).usual.shares)
    assert 0.06 < np.exp(np.log(found).mean()) < (0.14 if sigma < 0.3 else 0.2)


def test_places_are_told_apart_by_how_steadily_this_body_moved() -> None:
    """Half a metre on is beyond a body that kept its velocity to a centimetre; any other may as well be there."""
    steady = learnt_from(0.01 * np.random.default_rng(3).standard_normal((40, 6)))
    there = planar_transform(0.5, 0.0, 0.0)
    by_this, by_any = (Expected(np.eye(4), WEAK_PRIOR, prior).log_likelihood(there) for prior in (steady, None))
    assert by_this < -2.0 and -0.1 < by_any <= 0.0
