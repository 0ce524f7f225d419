"""How far beams scatter about lines, for lasers that nobody describes: what it should be in furnished rooms."""

import numpy as np
import pytest

from spplanes import LineConfig
from spplanes.lines.extraction import beam_noise
from tests.spplanes.lines.line_world import cast, random_corridor, random_room

#: By how much lines are looked for, m.
ABOUT_M = 0.02


@pytest.mark.parametrize("angles", [np.radians(np.arange(-90, 90, 1.0)), np.radians(np.arange(-180, 180, 0.5))])
@pytest.mark.parametrize("world", [random_room, random_corridor])
@pytest.mark.parametrize(
    ("sigma_m", "step_m"), [(0.003, 0.001), (0.003, 0.01), (0.015, 0.01), (0.03, 0.05), (0.06, 0.01)]
)
def test_beams_scatter_by_their_noise_and_the_steps_of_ranges(sigma_m, step_m, world, angles):
    """To 5 %: some 3,000 beams on some hundreds of lines tell it to 2 %."""
    rng, scans = np.random.default_rng(5), []
    for _ in range(30):
        made, pose = world(rng)
        ranges = cast(made, angles, pose).ranges + rng.normal(0.0, sigma_m, angles.size)
        scans.append((np.round(ranges / step_m) * step_m, angles))
    seen_m, telling = beam_noise(scans, ABOUT_M, LineConfig())
    assert telling > 2000
    assert seen_m == pytest.approx(np.hypot(sigma_m, step_m / np.sqrt(12.0)), rel=0.05)


def test_scans_without_lines_and_those_that_are_refused_tell_nothing():
    nothing = (np.full(180, np.nan), np.radians(np.arange(-90, 90, 1.0)))
    assert beam_noise([], ABOUT_M, LineConfig()) == (ABOUT_M, 0)
    in_degrees, few = (np.ones(180), np.arange(-90, 90, 1.0)), (np.ones(2), np.zeros(2))
    assert beam_noise([nothing, in_degrees, few], ABOUT_M, LineConfig()) == (ABOUT_M, 0)
