"""How a body changes its velocity is learnt from few steps, noisy ones too, and no body is taken for steadier."""

import numpy as np
import pytest

from slam.frontend.steadiness import Steadiness

BODIES = 300


@pytest.mark.parametrize("steps", [8, 30])
@pytest.mark.parametrize(
    "share, noise", [(0.3, 0.01), (0.1, 0.01), (0.03, 0.01), (0.03, 0.03), (0.01, 0.01), (0.003, 0.01), (0.01, 0.1)]
)
def test_changes_are_as_large_as_is_said_and_where_noise_hides_them_no_larger(
    share: float, noise: float, steps: int
) -> None:
    """Mean chi2 of the next usual change over the variance that is said: the said one is of a t, wider than of normals.

    The mean of logarithms has up to 0.8, and without a least share 1.5 where steps are as noisy as changes are large.
    """
    rng = np.random.default_rng(1)
    any_body, known = np.ones(BODIES), np.full(BODIES, noise**2)

    def change() -> np.ndarray:
        usual, rare = share * rng.standard_normal(BODIES), rng.standard_normal(BODIES)
        return np.where(rng.random(BODIES) < 0.02, rare, usual)

    learnt = Steadiness(BODIES)
    for _ in range(steps):
        learnt.learn(change() + noise * rng.standard_normal(BODIES), any_body, known, np.ones(BODIES, dtype=bool))
    usual = learnt.usual()
    said = any_body - usual._replace(rates=np.zeros(BODIES)).less(any_body)
    mean = np.mean(share**2 / said)
    assert mean < 0.65
    if share >= max(noise, 0.03):  # none is believed to be much steadier
        assert mean > 0.3
