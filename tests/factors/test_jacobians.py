"""Derivatives of every factor against central differences, at random linearisation points."""

import gtsam
import numpy as np
import pytest

import factors
from tests.factors.factor_scenes import (
    TIED_NORMALS,
    A,
    L,
    X,
    assert_jacobian,
    random_line,
    random_normals,
    random_plane,
    random_pose,
    values_of,
)

SEEDS = range(200)
A1, L1 = (gtsam.symbol(letter, 1) for letter in "al")
HOMES = [(None, None), (A, None), (None, A1), (A, A1), (A, A)]


def landmark(rng: np.random.Generator) -> gtsam.OrientedPlane3:
    normal = TIED_NORMALS[rng.integers(len(TIED_NORMALS))] if rng.random() < 0.3 else random_normals(rng, 1)[0]
    return gtsam.OrientedPlane3(np.array([*normal, rng.normal() * 3.0]))


def scene(rng: np.random.Generator) -> gtsam.Values:
    poses = {name: random_pose(rng) for name in ("x0", "x1", "a0", "a1")}
    return values_of(l0=landmark(rng), l1=landmark(rng), **poses)


@pytest.mark.parametrize("anchor", [A, None, X], ids=["anchored", "world", "own anchor"])
@pytest.mark.parametrize(
    "make",
    [
        lambda rng, anchor: factors.plane_factor(random_plane(rng), X, L, anchor_key=anchor),
        lambda rng, anchor: factors.line_factor(random_line(rng), random_pose(rng).matrix(), X, L, anchor_key=anchor),
        lambda rng, anchor: factors.direction_prior(L, rng.normal(size=3), 0.1, anchor_key=anchor),
        lambda rng, anchor: factors.upright_prior(L, 0.1, up=rng.normal(size=3), anchor_key=anchor),
        lambda rng, anchor: factors.plane_prior(random_plane(rng), L),
    ],
    ids=["plane", "line", "direction", "upright", "prior"],
)
def test_factors_of_one_landmark(make, anchor):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        assert_jacobian(make(rng, anchor), scene(rng))


@pytest.mark.parametrize("anchor", [A, None, X], ids=["anchored", "world", "own anchor"])
def test_factors_on_pose2(anchor):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        x, a = (gtsam.Pose2(*rng.normal(size=3)) for _ in range(2))
        values = values_of(l0=landmark(rng), l1=landmark(rng), x0=x, a0=a)
        for factor in (
            factors.line_factor_2d(random_line(rng), random_pose(rng).matrix(), X, L, anchor_key=anchor),
            factors.upright_prior(L, 0.1, up=rng.normal(size=3), anchor_key=anchor),
            factors.parallel_factor(L, L1, 0.1, anchor_a=anchor, anchor_b=A),
        ):
            assert_jacobian(factor, values)


@pytest.mark.parametrize(("anchor_a", "anchor_b"), HOMES)
def test_factors_of_two_landmarks(anchor_a, anchor_b):
    where = {"anchor_a": anchor_a, "anchor_b": anchor_b}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        values = scene(rng)
        assert_jacobian(factors.parallel_factor(L, L1, 0.1, **where), values)
        assert_jacobian(factors.perpendicular_factor(L, L1, 0.1, **where), values)
        gap = factors.distance_factor(L, L1, 1.5, 0.1, at=rng.normal(size=3), **where)
        if factors.perpendicular_factor(L, L1, 1e-3, **where).error(values) > 1.0:  # at right angles its sign jumps
            assert_jacobian(gap, values)
