"""extract_lines on scans whose lines are known: one wall, corners, the seam, holes, pillars, mixed pixels."""

import numpy as np
import pytest

from spplanes import LineConfig, extract_lines
from tests.spplanes.lines.line_world import World, cast, nees, polygon, true_line

SIGMA = 0.01
HALF = np.radians(np.arange(-90, 90.01, 0.5))
FULL = np.radians(np.arange(-180, 180, 1.0))
NO_CIRCLES = np.empty((0, 3))
ROOM = World(polygon([(-2, -1), (4, -1), (4, 3), (-2, 3)]), NO_CIRCLES)


def walls(*segments):
    return World(np.array(segments, dtype=float), NO_CIRCLES)


def wall(*points):
    return walls(points)


def scan(world, angles, pose=(0.0, 0.0, 0.0), sigma=SIGMA, seed=0):
    ranges = cast(world, angles, pose).ranges
    return ranges + np.random.default_rng(seed).normal(0.0, sigma, angles.size)


def test_a_single_wall():
    world = wall((3, -2), (3, 2))
    (line,) = extract_lines(scan(world, HALF), HALF, sigma=SIGMA)
    assert line.alpha == pytest.approx(0.0, abs=0.01)
    assert line.rho == pytest.approx(3.0, abs=0.01)
    np.testing.assert_allclose(line.endpoints, [(3, -2), (3, 2)], atol=0.05)
    np.testing.assert_allclose(line.endpoints @ line.normal, line.rho, atol=1e-12)
    assert line.indices.dtype == np.int64
    assert np.array_equal(line.indices, np.flatnonzero(np.isfinite(scan(world, HALF))))
    assert 0.5 < line.chi2 / line.dof < 1.5


def test_each_beam_has_its_own_sigma():
    truth = cast(wall((3, -2), (1, 2)), HALF).ranges
    sigmas = np.where(HALF > 0.2, 0.05, 0.005)
    rng = np.random.default_rng(2)
    found = [extract_lines(truth + sigmas * rng.normal(size=HALF.size), HALF, sigma=sigmas) for _ in range(600)]
    errors = [nees(lines[0], true_line(np.array([(3.0, -2.0), (1.0, 2.0)]), (0, 0, 0))) for lines in found]
    assert all(len(lines) == 1 for lines in found)
    assert abs(np.mean(errors) - 2.0) < 1.96 * 2.0 / np.sqrt(len(errors))


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.5, np.pi, -2.0])
def test_a_room_has_four_walls_wherever_the_seam_is(turn):
    lines = extract_lines(scan(ROOM, FULL, (0, 0, turn)), FULL, sigma=SIGMA)
    assert sorted(round(line.rho, 1) for line in lines) == [1.0, 2.0, 3.0, 4.0]
    assert sum(line.indices.size for line in lines) >= 355
    assert all(np.all(np.diff(np.unwrap(FULL[line.indices])) > 0) for line in lines)


def test_a_wall_across_the_seam_keeps_beam_order_and_is_one_on_both_sides_of_a_pillar():
    (back,) = [line for line in extract_lines(scan(ROOM, FULL), FULL, sigma=SIGMA) if abs(line.rho - 2.0) < 0.1]
    assert back.indices[0] > 300 and back.indices[-1] < 60
    np.testing.assert_allclose(back.endpoints, [(-2, 3), (-2, -1)], atol=0.1)
    lines = extract_lines(scan(World(ROOM.segments, np.array([(-1.0, 0.0, 0.1)])), FULL), FULL, sigma=SIGMA)
    assert sorted(round(line.rho, 1) for line in lines) == [1.0, 2.0, 3.0, 4.0]


def test_beams_in_any_order_give_the_same_lines():
    ranges, shuffle = scan(ROOM, HALF), np.random.default_rng(3).permutation(HALF.size)
    lines = extract_lines(ranges, HALF, sigma=SIGMA)
    shuffled = extract_lines(ranges[shuffle], HALF[shuffle], sigma=SIGMA)
    clockwise = extract_lines(ranges[::-1], HALF[::-1], sigma=SIGMA)
    for line, same, turned in zip(lines, shuffled, clockwise, strict=True):
        assert (line.alpha, line.rho) == pytest.approx((same.alpha, same.rho), abs=1e-12)
        assert np.array_equal(line.indices, shuffle[same.indices])
        assert np.array_equal(line.indices, HALF.size - 1 - turned.indices)


def test_whatever_is_no_return_is_left_out():
    ranges = scan(ROOM, HALF)
    ranges[10:13], ranges[30], ranges[60:62], ranges[200:203] = np.nan, 0.0, np.inf, 8.19
    ranges[250] = -1.0
    lines = extract_lines(ranges, HALF, sigma=SIGMA, config=LineConfig(range_max=8.0))
    assert [round(line.rho, 1) for line in lines] == [1.0, 4.0, 3.0]
    gone = {10, 11, 12, 30, 60, 61, 200, 201, 202, 250}
    assert not gone & set(np.concatenate([line.indices for line in lines]).tolist())


@pytest.mark.parametrize(
    "ranges", [np.full(181, np.nan), np.zeros(181), np.empty(0), np.ones(2), np.r_[1.0, np.zeros(180)]]
)
def test_nothing_seen_gives_no_lines(ranges):
    assert extract_lines(ranges, np.linspace(-1.5, 1.5, ranges.size), sigma=SIGMA) == []


def test_walls_with_an_open_door_or_nothing_between_are_two():
    world = walls([(3, -2), (3, -0.5)], [(3, 0.5), (3, 2)], [(6, -2), (6, 2)])
    near = [line for line in extract_lines(scan(world, HALF), HALF, sigma=SIGMA) if line.rho < 4]
    assert [round(line.length, 1) for line in near] == [1.5, 1.5]
    far = np.isin(np.arange(HALF.size), np.r_[60:80, 280:300])
    ranges = np.where(far, cast(wall((2, -3), (2, 3)), HALF).ranges, np.nan)
    assert len(extract_lines(ranges, HALF, sigma=SIGMA)) == 2


@pytest.mark.parametrize("sigma", [0.005, 0.01, 0.02])
def test_two_walls_at_170_degrees_are_two(sigma):
    bend = np.array([(3, -2), (3, 0), (3 - 2 * np.sin(np.radians(10)), 2 * np.cos(np.radians(10)))])
    world = walls(bend[:2], bend[1:])
    for seed in range(20):
        lines = extract_lines(scan(world, HALF, sigma=sigma, seed=seed), HALF, sigma=sigma)
        assert len(lines) == 2
        assert abs(np.degrees(lines[1].alpha - lines[0].alpha) - 10) < 4
        assert np.hypot(*(lines[0].endpoints[1] - bend[1])) < 0.4


def test_grazing_angles():
    """A corridor of 2 m, seen from its middle: its walls under up to 88 degrees of incidence, 0.5 degrees apart."""
    world = walls([(-1, -1), (30, -1)], [(-1, 1), (30, 1)])
    errors, reach = [], []
    for seed in range(100):
        lines = extract_lines(scan(world, HALF, (0, 0, 0.1), seed=seed), HALF, sigma=SIGMA)
        assert len(lines) == 2
        errors += [nees(line, true_line(world.segments[i], (0, 0, 0.1))) for i, line in enumerate(lines)]
        reach += [np.hypot(*lines[0].endpoints[1]), np.hypot(*lines[1].endpoints[0])]
    assert abs(np.mean(errors) - 2.0) < 1.96 * 2.0 / np.sqrt(200)
    assert min(reach) > 20.0


def test_pillars_are_no_lines():
    """600 pillars of 3 cm to 1 m radius under noise of 3 to 30 mm: fewer than 2 in 100 leave a line."""
    angles = np.radians(np.arange(-135, 135.01, 0.25))
    n_lines = 0
    for radius in (0.03, 0.1, 0.25, 0.5, 1.0):
        world = World(np.empty((0, 2, 2)), np.array([(2.0, 0.3, radius), (-1.0, radius + 1.0, radius)]))
        for sigma in (0.003, 0.01, 0.03):
            for seed in range(20):
                n_lines += len(extract_lines(scan(world, angles, sigma=sigma, seed=seed), angles, sigma=sigma))
    assert n_lines < 12


def test_mixed_pixels_at_the_ends_are_trimmed_and_nothing_else():
    """Two beams at each end of a wall lie between it and the wall 2 m behind."""
    world = walls([(3, -1), (3, 1)], [(5, -5), (5, 5)])
    hits = np.flatnonzero(cast(world, HALF).hits == 0)
    lost, errors = [], []
    for seed in range(100):
        ranges = scan(world, HALF, seed=seed)
        ranges[[hits[0], hits[-1]]] += 0.3
        ranges[[hits[0] - 1, hits[-1] + 1]] -= 1.0
        (line,) = [line for line in extract_lines(ranges, HALF, sigma=SIGMA) if abs(line.rho - 3) < 0.2]
        assert not {hits[0], hits[-1], hits[0] - 1, hits[-1] + 1} & set(line.indices.tolist())
        lost.append(hits.size - 2 - line.indices.size)
        errors.append(nees(line, (0.0, 3.0)))
    assert np.mean(lost) < 0.05
    assert abs(np.mean(errors) - 2.0) < 1.96 * 2.0 / np.sqrt(100)


def test_glass_dropouts_and_outliers_leave_the_wall_whole():
    dropped, spoilt = scan(wall((3, -2), (3, 2)), HALF), scan(wall((3, -2), (3, 2)), HALF)
    dropped[np.random.default_rng(5).random(HALF.size) < 0.4] = np.nan
    dropped[170:185] = np.nan
    spoilt[150], spoilt[200:202], spoilt[210] = 1.0, 2.5, 3.3
    for ranges, most in ((dropped, 0.15), (spoilt, 0.05)):
        (line,) = extract_lines(ranges, HALF, sigma=SIGMA)
        assert line.length == pytest.approx(4.0, abs=most)
    assert not {150, 200, 201, 210} & set(line.indices.tolist())


def test_clutter_and_beams_along_one_bearing_are_no_lines():
    """A wall that passes through the sensor is seen edge-on: what it sends back has one bearing."""
    rng = np.random.default_rng(6)
    assert not any(extract_lines(rng.uniform(1, 4, HALF.size), HALF, sigma=SIGMA) for _ in range(200))
    assert extract_lines(np.linspace(1, 3, 40), np.full(40, 0.3), sigma=SIGMA) == []
    two = np.r_[np.full(20, 0.3), np.full(20, 0.3 - np.pi)]
    assert extract_lines(np.tile(np.linspace(1, 3, 20), 2), two, sigma=SIGMA) == []


@pytest.mark.parametrize(("rho", "most"), [(0.1, 1), (0.03, 3)])
def test_a_wall_at_the_sensor(rho, most):
    """Docked 10 or 3 cm from a wall. At 3 cm, three sigma of the noise, rho stays positive and the main line right."""
    for seed in range(20):
        lines = extract_lines(scan(wall((rho, -3), (rho, 3)), HALF, seed=seed), HALF, sigma=SIGMA)
        main = max(lines, key=lambda line: line.indices.size)
        assert len(lines) <= most
        assert min(line.rho for line in lines) > 0 and nees(main, (0.0, rho)) < 25


def test_bearing_noise_is_in_the_covariance():
    world, noise = wall((2, -1), (12, 1)), 0.002
    rng = np.random.default_rng(7)
    errors = {0.0: [], noise: []}
    for _ in range(300):
        ranges = cast(world, HALF + rng.normal(0, noise, HALF.size)).ranges + rng.normal(0, SIGMA, HALF.size)
        for bearing_sigma, values in errors.items():
            lines = extract_lines(ranges, HALF, sigma=SIGMA, config=LineConfig(bearing_sigma=bearing_sigma))
            values += [nees(lines[0], true_line(world.segments[0], (0, 0, 0)))] if lines else []
    assert np.mean(errors[0.0]) > 4.0
    assert len(errors[noise]) >= 297
    assert 1.7 < np.mean(errors[noise]) < 2.5


def test_flatness_adds_to_shift_and_direction_and_nothing_else():
    ranges = scan(wall((3, -2), (1, 2)), HALF)
    (exact,), (rough,) = (
        extract_lines(ranges, HALF, sigma=SIGMA, config=LineConfig(flatness=flatness)) for flatness in (0.0, 0.004)
    )
    added = rough.covariance - exact.covariance
    middle = exact.endpoints.mean(axis=0) @ exact.direction
    assert added[0, 0] == pytest.approx(12 * (0.004 / exact.length) ** 2)
    assert added[0, 1] == pytest.approx(middle * added[0, 0])
    assert added[1, 1] == pytest.approx(0.004**2 + middle**2 * added[0, 0])
    assert (rough.alpha, rough.rho) == (exact.alpha, exact.rho)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ranges": np.ones((3, 3))}, r"ranges: expected shape \(N,\), got \(3, 3\)"),
        ({"angles": np.ones(5)}, r"angles: expected shape \(361,\), got \(5,\)"),
        ({"angles": np.full(361, np.nan)}, "angles: expected finite numbers, got NaN or infinity"),
        ({"sigma": 0.0}, "sigma: expected a positive finite number, got 0.0"),
        ({"sigma": -np.ones(361)}, "sigma: expected positive standard deviations, got -1.0"),
        ({"sigma": np.ones(3)}, r"sigma: expected shape \(361,\), got \(3,\)"),
        ({"ranges": "wall"}, "ranges: expected an array of numbers, got str"),
    ],
)
def test_bad_input_is_one_sentence(arguments, message):
    given = {"ranges": np.ones(361), "angles": HALF, "sigma": SIGMA} | arguments
    with pytest.raises(ValueError, match=message):
        extract_lines(given["ranges"], given["angles"], sigma=given["sigma"])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("significance", 0.0),
        ("significance", np.nan),
        ("min_points", 2),
        ("min_points", 6.5),
        ("max_missing", -1),
        ("max_turning", 4.0),
        ("max_nonlinearity", 0.0),
        ("max_misfit", 1.0),
        ("bearing_sigma", -0.1),
        ("flatness", -0.1),
        ("range_min", -1.0),
        ("range_max", 0.0),
    ],
)
def test_impossible_configurations_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field}: expected .* got {value}"):
        LineConfig(**{field: value})
