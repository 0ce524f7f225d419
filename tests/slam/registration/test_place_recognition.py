"""Constellations of walls: the same place is found with an honest covariance; other places and corridors are not."""

import numpy as np
import pytest

from slam.geometry.frames import planar_transform
from slam.registration.place_recognition import Wall, match_constellations
from spplanes import extract_lines
from tests.spplanes.lines.line_world import World, cast, polygon, random_corridor, random_room
from tests.statistics import assert_mean_in_band

FULL = np.radians(np.arange(-180, 180, 0.5))
SIGMA = 0.01


def random_place(rng, n=16):
    """Ends of walls in four directions and a few others, shape (n, 2, 2); each is seen from one side."""
    middles = rng.uniform(-4.0, 4.0, (n, 2))
    turns = np.where(rng.random(n) < 0.2, rng.uniform(-1, 1, n), 0)
    angles = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2], n) + turns
    half = rng.uniform(0.5, 2.0, n)[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return np.stack((middles - half, middles + half), axis=1)


def see(place, pose, rng, kept=1.0):
    """Walls of a place in the frame of `pose`, each with noise of its own covariance; and which walls they are."""
    seen, walls = np.flatnonzero(rng.random(len(place)) < kept), []
    for segment in place[seen]:
        ends = (segment - pose[:2]) @ planar_transform(0, 0, pose[2])[:2, :2]
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        length, middle = np.hypot(*(ends[1] - ends[0])), ends.mean(axis=0) @ along
        jacobian = np.array(((1.0, 0.0), (middle, 1.0)))
        covariance = jacobian @ np.diag((12 * 0.005**2 / length**2, 0.005**2)) @ jacobian.T
        error, alpha = rng.multivariate_normal((0.0, 0.0), covariance), np.arctan2(-along[0], along[1])
        rho = ends[0] @ (np.cos(alpha), np.sin(alpha))
        walls.append(Wall(alpha + error[0], rho + error[1], covariance, ends))
    return walls, seen


def error_of(match, pose_a, pose_b):
    b_T_a, found = np.linalg.inv(planar_transform(*pose_b)) @ planar_transform(*pose_a), match.b_T_a
    turn = np.arctan2(found[1, 0], found[0, 0]) - np.arctan2(b_T_a[1, 0], b_T_a[0, 0])
    return np.array((*(found[:2, 3] - b_T_a[:2, 3]), (turn + np.pi) % (2 * np.pi) - np.pi))


def random_pose(rng):
    return np.array((*rng.uniform(-2.0, 2.0, 2), rng.uniform(-np.pi, np.pi)))


def test_the_same_place_is_found_and_its_covariance_holds():
    rng = np.random.default_rng(0)
    errors, chi2_per_dof, right, closures = [], [], [], 0
    for _ in range(100):
        place, pose_a, pose_b = random_place(rng), random_pose(rng), random_pose(rng)
        (a, seen_a), (b, seen_b) = see(place, pose_a, rng, 0.9), see(place, pose_b, rng, 0.9)
        match = match_constellations(a, b)
        if match is None or match.verdict != "closure":
            continue
        closures += 1
        right += (seen_a[match.pairs[:, 0]] == seen_b[match.pairs[:, 1]]).tolist()
        error = error_of(match, pose_a, pose_b)
        errors.append(error @ np.linalg.solve(match.covariance, error))
        chi2_per_dof.append(match.chi2 / match.n_dof)
        assert len(match.pairs) >= len(np.intersect1d(seen_a, seen_b)) - 1
    assert closures >= 90 and np.mean(right) > 0.98
    assert_mean_in_band(np.array(errors), 3)
    assert 0.9 < np.mean(chi2_per_dof) < 1.1


def test_other_places_are_not_found():
    rng = np.random.default_rng(1)
    for _ in range(100):
        a, b = (see(random_place(rng), random_pose(rng), rng)[0] for _ in range(2))
        match = match_constellations(a, b)
        assert match is None or match.verdict != "closure"


def test_a_wall_is_not_its_own_back():
    rng = np.random.default_rng(3)
    place, pose = random_place(rng), random_pose(rng)
    a, b = see(place, pose, rng)[0], see(place[:, ::-1], pose, rng)[0]
    assert match_constellations(a, b) is None


def test_extents_must_overlap():
    rng = np.random.default_rng(4)
    place = random_place(rng)
    shifted = place + 2.0 * (place[:, 1] - place[:, 0])[:, None, :]
    a, b = (see(walls, np.zeros(3), rng)[0] for walls in (place, shifted))
    match = match_constellations(a, b)
    assert match is None or match.verdict == "unobservable"
    assert match_constellations(a, see(place, np.zeros(3), rng)[0]) is not None


def views(world, poses, seed=0):
    rng = np.random.default_rng(seed)
    ranges = [cast(world, FULL, tuple(pose)).ranges + rng.normal(0, SIGMA, FULL.size) for pose in poses]
    return [extract_lines(r, FULL, sigma=SIGMA) for r in ranges]


CORRIDOR = [[(-9, -1), (-4, -1)], [(-4, -1.1), (0.1, -1.1)], [(0, -1.25), (9, -1.25)]]
CORRIDOR += [[(9, 1), (1, 1)], [(1, 1.3), (-9, 1.3)], [(-9, 1.45), (-12, 1.45)]]


def test_a_room_that_looks_the_same_turned_round_is_ambiguous():
    """A rectangle with equal alcoves on opposite sides: every wall has its twin half a turn away."""
    half = [(-3, -2), (-1, -2), (-1, -3), (1, -3), (1, -2), (3, -2)]
    world = World(polygon(half + [(-x, -y) for x, y in half]), np.empty((0, 3)))
    match = match_constellations(*views(world, [(0.3, 0.2, 0.0), (-0.2, 0.4, 1.0)]))
    assert match is not None and match.verdict in ("ambiguous", "unobservable") and match.rival_evidence > 0.0


def test_a_corridor_leaves_open_how_far_along_it():
    """Walls of four depths on both sides of a corridor without an end: all matched, none across."""
    rng = np.random.default_rng(5)
    a, b = (see(np.array(CORRIDOR, dtype=float), pose, rng)[0] for pose in ((-1.0, 0.0, 0.0), (0.5, 0.2, 0.1)))
    match = match_constellations(a, b)
    assert match.verdict == "unobservable" and len(match.pairs) >= 5
    variances, axes = np.linalg.eigh(match.covariance[:2, :2])
    assert variances[1] > 1.0 and abs(axes[:, 1] @ (np.cos(0.1), -np.sin(0.1))) > 0.99


def test_one_wall_across_a_corridor_is_no_proof():
    """Two floors of one building: the same corridor, long walls at ten depths, but its end wall 2 m farther."""
    depths = [((-9, y), (9, y)) for y in (-1.0, -1.3, -1.7, -2.2, -2.8)]
    depths += [((9, y), (-9, y)) for y in (1.1, 1.5, 1.9, 2.6, 3.1)]
    rng = np.random.default_rng(6)
    a, b = (see(np.array([*depths, ((x, -1), (x, 1))], dtype=float), (0.0, 0.0, 0.0), rng)[0] for x in (6, 8))
    match = match_constellations(a, b)
    assert len(match.pairs) == 11 and match.verdict == "unobservable"


@pytest.mark.parametrize("make", [random_room, random_corridor])
def test_random_worlds_give_no_wrong_closure(make):
    rng = np.random.default_rng(7)
    closures, wrong, before = 0, 0, []
    for _ in range(40):
        world, pose = make(rng)
        poses = np.array((pose, (pose[0] + rng.uniform(-0.2, 0.2), pose[1], rng.uniform(-np.pi, np.pi))))
        a, b = views(world, poses, seed=int(rng.integers(1 << 30)))
        match = match_constellations(a, b)
        if match is not None and match.verdict == "closure":
            error = error_of(match, *poses)
            closures += 1
            assert np.hypot(*error[:2]) < 0.05
            wrong += error @ np.linalg.solve(match.covariance, error) > 30.0
        for other in before[-2:]:
            match = match_constellations(other, b)
            wrong += match is not None and match.verdict == "closure"
        before.append(a)
    assert wrong == 0 and closures >= (30 if make is random_room else 0)


def test_too_few_walls_are_no_match():
    rng = np.random.default_rng(10)
    walls = see(random_place(rng, 3), np.zeros(3), rng)[0]
    assert match_constellations([], walls) is None and match_constellations(walls, walls) is None


def test_a_bad_significance_is_one_sentence():
    with pytest.raises(ValueError, match=r"significance: expected a probability in \(0, 0.5\), got 0.0"):
        match_constellations([], [], significance=0.0)
