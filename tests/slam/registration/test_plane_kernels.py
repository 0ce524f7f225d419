"""Kernels of finding a motion by planes against the same written in whole arrays."""

from itertools import combinations

import gtsam
import numpy as np
import pytest

from slam.registration._plane_kernels import BEST, best_shifts, directions_found, unlike
from slam.registration.plane_registration import near_rotations

DISTANCE, SIGMA, TAIL = 0.1, 0.5, 2.0


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    normals = rng.standard_normal((count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.array([gtsam.Rot3.Expmap(rng.standard_normal(3)).matrix() for _ in range(count)])


def test_rotations_are_those_of_equal_angles_that_turn_little():
    rng = np.random.default_rng(0)
    frames, others = rotations(rng, 12), rotations(rng, 15)
    angles, other_angles = rng.uniform(0.5, 1.5, 12), rng.uniform(0.5, 1.5, 15)
    found, traces = near_rotations((frames, angles), (others, other_angles), 0.3, 0.4)
    wanted = [
        other @ frame.T
        for frame, angle in zip(frames, angles, strict=True)
        for other, other_angle in zip(others, other_angles, strict=True)
        if abs(angle - other_angle) < 0.3 and np.trace(other @ frame.T) > 0.4
    ]
    assert 16 < len(wanted) < 12 * 15
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    np.testing.assert_allclose(traces, np.trace(found, axis1=1, axis2=2), atol=1e-12)


def test_directions_found_weigh_every_normal_once():
    rng = np.random.default_rng(1)
    turns, normals, others = rotations(rng, 20), directions(rng, 7), directions(rng, 30)
    weights = rng.uniform(0.5, 2.0, 7)
    agree = np.einsum("kij,nj,mi->knm", turns, normals, others).max(axis=2) > 0.95
    assert 0.1 < agree.mean() < 0.9
    np.testing.assert_allclose(directions_found(turns, normals, others, weights, 0.95), agree @ weights, rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_best_shifts_are_the_best_of_all_threes(seed):
    rng = np.random.default_rng(seed)
    weights, own = np.sort(rng.uniform(0.2, 3.0, 12))[::-1].copy(), np.sort(rng.integers(0, 12, 40))
    normals, offsets = directions(rng, 40), rng.normal(0.0, 0.3, 40)
    strongest, middles, reaches = rng.permutation(40)[:14], rng.normal(0.0, 0.5, (40, 3)), rng.uniform(0.0, 2.0, 40)
    shifts, found, scores = [], [], []
    for triple in combinations(strongest, 3):
        n, d = normals[list(triple)], offsets[list(triple)]
        shift = np.linalg.solve(n.T @ n / DISTANCE**2 + np.eye(3) / SIGMA**2, n.T @ d / DISTANCE**2)
        near = np.maximum(1.0 - np.abs(normals @ shift - offsets) / DISTANCE, 0.0)
        near[np.linalg.norm(middles - shift, axis=1) >= reaches] = 0.0
        shifts.append(shift)
        found.append(sum(weights[k] * near[own == k].max() for k in np.unique(own)))
        scores.append(found[-1] - TAIL * np.log1p(0.5 * shift @ shift / SIGMA**2 / TAIL))
    got, weight = best_shifts(own, normals, offsets, weights, middles, reaches, strongest, DISTANCE, SIGMA, TAIL)
    known = np.array(shifts)
    rows = [int(np.argmin(np.linalg.norm(known - one, axis=1))) for one in got]
    np.testing.assert_allclose(known[rows], got, atol=1e-9)
    np.testing.assert_allclose(weight, np.array(found)[rows], rtol=1e-12)
    ranks = np.array(scores)[rows]
    assert len(got) == BEST and ranks[0] == max(scores) and (np.diff(ranks) <= 0.0).all()
    assert min(np.linalg.norm(a - b) for a, b in combinations(got, 2)) >= 0.5 * DISTANCE


def test_of_rotations_none_is_kept_that_is_like_a_better_one() -> None:
    rng = np.random.default_rng(4)
    turns = np.array([gtsam.Rot3.Expmap(0.2 * rng.standard_normal(3)).matrix() for _ in range(300)])
    trace, left, chosen = 1.0 + 2.0 * np.cos(0.1), turns.reshape(-1, 9), []
    while len(left):
        chosen.append(left[0])
        left = left[left @ left[0] < trace]
    np.testing.assert_array_equal(turns[unlike(turns, trace, 1000)].reshape(-1, 9), chosen)
    np.testing.assert_array_equal(turns[unlike(turns, trace, 7)].reshape(-1, 9), chosen[:7])
    assert 20 < len(chosen) < 300
