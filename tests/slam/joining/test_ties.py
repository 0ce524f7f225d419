"""Ties: nothing between two landmarks of one plane, and derivatives that are the derivatives."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.joining.solution import TiedKeys, tied_difference
from tests.statistics import assert_jacobian

FIRST, SECOND = TiedKeys(1, 2, 3), TiedKeys(4, 5, 6)


def values_of(seed: int, off: np.ndarray) -> gtsam.Values:
    """Two missions that see one plane, which the second has a little off."""
    rng = np.random.default_rng(seed)
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6) * (0.6, 0.6, 0.6, 3.0, 3.0, 3.0)) for _ in range(4)]
    plane = gtsam.OrientedPlane3(np.append(rng.normal(size=3), rng.normal()))
    values = gtsam.Values()
    for side, (base, anchor) in zip((FIRST, SECOND), (poses[:2], poses[2:]), strict=True):
        values.insert(side.base, base)
        values.insert(side.anchor, anchor)
        values.insert(side.plane, plane.transform(base.compose(anchor)))
    values.update(SECOND.plane, values.atOrientedPlane3(SECOND.plane).retract(off))
    return values


@pytest.mark.parametrize("seed", range(5))
def test_the_distance_is_that_of_the_planes(seed: int):
    difference, _ = tied_difference(values_of(seed, np.array([0.0, 0.0, 0.25])), FIRST, SECOND)
    np.testing.assert_allclose(difference, [0.0, 0.0, 0.25], atol=1e-12)  # Hesse: d of OrientedPlane3 is the other sign


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_of_a_tie(seed: int):
    """By central differences, where the planes are one: there the basis that the tilt is told in does not matter."""
    start = values_of(seed, np.zeros(3))
    _, blocks = tied_difference(start, FIRST, SECOND)
    keys = [key for side in (FIRST, SECOND) for key in (side.base, side.anchor, side.plane)]
    for key, block in zip(keys, blocks, strict=True):

        def moved(step: np.ndarray, key: int = key) -> np.ndarray:
            steps, values = gtsam.VectorValues(), gtsam.Values(start)
            steps.insert(key, step)
            return tied_difference(values.retract(steps), FIRST, SECOND)[0]

        assert_jacobian(moved, np.zeros(block.shape[1]), block, atol=1e-6)
