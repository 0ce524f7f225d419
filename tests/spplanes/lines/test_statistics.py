"""extract_lines on random rooms and corridors with truth: what it finds, what it invents, whether its covariance holds.

What is detectable, found and false is defined by `Score`. 180 to 1081 beams, 180 to 360 degrees,
sigma 5 to 30 mm. At the end: the range noise that a line shows of itself.
"""

import numpy as np
import pytest

from spplanes import LineConfig, extract_lines
from spplanes.lines.extraction import beam_noise
from tests.spplanes.lines.line_world import Score, cast, random_corridor, random_room

LASERS = (
    np.radians(np.arange(-90, 90, 1.0)),
    np.radians(np.arange(-90, 90.01, 0.5)),
    np.radians(np.arange(-180, 180, 1.0)),
    np.radians(np.arange(-135, 135.01, 0.25)),
)


@pytest.mark.parametrize("sigma", [0.005, 0.01, 0.015, 0.03])
@pytest.mark.parametrize("world", [random_room, random_corridor])
def test_walls_are_found_whole_none_is_invented_and_their_covariance_is_honest(world, sigma):
    """Mean NEES inside its 95 % band about 2, beams of the neighbouring surfaces taken in or not.

    Of the beams that hit a wall fewer than one in two walls misses one; as many of the next wall are taken.
    """
    result, config = Score(), LineConfig()
    for angles in LASERS:
        rng = np.random.default_rng(11)
        for _ in range(25):
            made, pose = world(rng)
            truth = cast(made, angles, pose)
            ranges = truth.ranges + rng.normal(0.0, sigma, angles.size)
            lines = extract_lines(ranges, angles, sigma=sigma, config=config)
            result.add_scan(made, pose, truth, lines, angles, sigma, config)
    assert result.detectable > 300
    assert result.found >= 0.97 * result.detectable
    assert result.false <= 0.02 * result.lines
    assert abs(np.mean(result.nees) - 2.0) < 1.96 * 2.0 / np.sqrt(len(result.nees))
    assert np.mean(result.lost_beams) < 0.6
    assert np.mean(result.lost_beams) - np.mean(result.excess_beams) < 0.1


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
