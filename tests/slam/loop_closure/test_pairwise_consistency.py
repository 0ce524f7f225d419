"""Proposed closures: those that agree with one another and the way between are closed together, and no others."""

from itertools import combinations, product

import numpy as np
import pytest

from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.loop_closure.pairwise_consistency import (
    Proposal,
    agree,
    counted_once,
    joint_log_odds,
    loop_chi2,
    maximal_cliques,
)
from slam.registration.submaps import PlanarPose
from tests.statistics import assert_mean_in_band

CLOSURE = np.diag((0.03, 0.02, 0.005)) ** 2
STEP = np.array(((4e-4, 1e-4, 0.0), (1e-4, 9e-4, 2e-5), (0.0, 2e-5, 4e-5)))


def disturbed(a_T_b: np.ndarray, covariance: np.ndarray, rng: np.random.Generator) -> PlanarPose:
    return PlanarPose(planar_delta(a_T_b) + np.linalg.cholesky(covariance) @ rng.standard_normal(3), covariance)


def scene(rng: np.random.Generator, wrong: np.ndarray) -> tuple[Proposal, Proposal, PlanarPose, PlanarPose]:
    """Two closures of one lap, the second wrong by a motion (3,), with the ways between their ends."""
    old, new = planar_transform(0.0, 0.0, 0.3), planar_transform(0.4, 0.2, 2.9)
    older, newer = planar_transform(3.0, 0.5, 0.4), planar_transform(-2.5, 1.0, 0.7)
    first = Proposal(10, 1, disturbed(inverse(old) @ new, CLOSURE, rng), 5.0, 60.0)
    there = inverse(old @ older) @ new @ newer @ planar_transform(*wrong)
    second = Proposal(14, 5, disturbed(there, CLOSURE, rng), 5.0, 64.0)
    return first, second, disturbed(newer, STEP, rng), disturbed(older, STEP, rng)


def test_chi2_of_a_loop_of_two_closures_is_chi2():
    rng = np.random.default_rng(0)
    values = [loop_chi2(*scene(rng, np.zeros(3))) for _ in range(2000)]
    assert_mean_in_band(values, 3, level=0.998)
    assert np.mean([agree(one, 0.01) for one in values]) == pytest.approx(0.99, abs=0.007)


@pytest.mark.parametrize("wrong", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.1)])
def test_closures_that_contradict_each_other_do_not_agree(wrong: tuple[float, float, float]):
    rng = np.random.default_rng(1)
    assert not any(agree(loop_chi2(*scene(rng, np.array(wrong))), 1e-3) for _ in range(50))


def test_motions_one_after_another_have_the_covariance_of_samples():
    rng = np.random.default_rng(2)
    first, after = planar_transform(3.0, -1.0, 2.0), planar_transform(0.5, 2.0, -0.4)
    draws = ((disturbed(first, STEP, rng).delta, disturbed(after, CLOSURE, rng).delta) for _ in range(20000))
    sampled = [planar_delta(planar_transform(*one) @ planar_transform(*other)) for one, other in draws]
    together = PlanarPose(planar_delta(first), STEP) @ PlanarPose(planar_delta(after), CLOSURE)
    np.testing.assert_allclose(together.delta, planar_delta(first @ after), atol=1e-12)
    np.testing.assert_allclose(together.covariance, np.cov(np.array(sampled).T), rtol=0.06, atol=2e-5)


def test_headings_half_a_turn_apart_are_compared_round_the_circle():
    near, other = (PlanarPose(np.array((0.0, 0.0, sign * 3.14)), CLOSURE) for sign in (1.0, -1.0))
    assert near.chi2(other) == pytest.approx((2.0 * np.pi - 6.28) ** 2 / (2.0 * CLOSURE[2, 2]))


def test_cliques_are_all_maximal_sets_that_agree():
    rng = np.random.default_rng(3)
    for count, density in product((1, 2, 5, 8), (0.2, 0.6, 0.9)):
        upper = np.triu(rng.random((count, count)) < density, 1)
        agreeing = upper | upper.T | np.eye(count, dtype=bool)
        some = (set(one) for size in range(1, count + 1) for one in combinations(range(count), size))
        sets = [one for one in some if agreeing[np.ix_(list(one), list(one))].all()]
        maximal = [sorted(one) for one in sets if not any(one < other for other in sets)]
        assert maximal_cliques(agreeing) == sorted(maximal)


def test_what_two_closures_saw_both_counts_once():
    pose = PlanarPose(np.zeros(3), CLOSURE)
    first, again, later = (Proposal(k, 0, pose, 4.0, way) for k, way in ((10, 50.0), (11, 53.0), (12, 60.0)))
    assert joint_log_odds([first], 6.0) == 4.0 and joint_log_odds([first, again], 6.0) == pytest.approx(6.0)
    assert joint_log_odds([later, first], 6.0) == pytest.approx(8.0)
    halved, beside = (
        counted_once([first, other], 6.0, 1.0, -np.inf)[1] for other in (again, Proposal(10, 4, pose, 3.0, 50.0))
    )
    np.testing.assert_allclose(halved.pose.covariance, 2.0 * CLOSURE)
    np.testing.assert_allclose(beside.pose.covariance, 6.0 * CLOSURE)
    np.testing.assert_allclose(counted_once([later, first], 6.0, 1.0, -np.inf)[1].pose.covariance, CLOSURE)
    np.testing.assert_allclose(counted_once([first], 6.0, 1.0, 47.0)[0].pose.covariance, 2.0 * CLOSURE)
