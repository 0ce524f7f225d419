"""One submap in another: the likeliest place is found, rivals are counted, and places that are none are not taken."""

import numpy as np
import pytest

from slam.frontend.occupancy.raster import CELL_M, Raster, view_from
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.registration.correlative_search import PlaceView, evidence_at, search_place
from tests.slam.laser_floors import Drive, FloorPlan, Wheels, cast, ring
from tests.slam.laser_floors import drive as drive_plan

LOOKS = 9.0
ANGLES = np.linspace(-np.pi / 2, np.pi / 2, 181)


def submap(walls: np.ndarray, poses: list[np.ndarray], base: np.ndarray, rng: np.random.Generator) -> PlaceView:
    """What a laser sees of walls (W, 2, 2) from poses (x, y, theta), in the frame of one."""
    views = []
    for pose in poses:
        ranges = cast(walls, np.zeros((len(walls), 256)), pose, ANGLES) + rng.normal(0.0, 0.01, ANGLES.size)
        seen = ranges < 8.0
        ends = ranges[seen, None] * np.stack((np.cos(ANGLES[seen]), np.sin(ANGLES[seen])), axis=1)
        views.append(np.hstack((np.zeros_like(ends), ends)))
    frames = [planar_transform(*pose) for pose in poses]
    return PlaceView(Raster.of(view_from(planar_transform(*base), frames, views), 0.5))


def room() -> np.ndarray:
    """A room with an alcove: nothing in it repeats."""
    corners = [(0, 0), (6, 0), (6, 1.5), (7.2, 1.5), (7.2, 2.6), (6, 2.6), (6, 4), (2.2, 4), (2.2, 5.1), (0, 5.1)]
    return np.array([(a, b) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)], dtype=float)


def corridor(doors: list[float]) -> np.ndarray:
    """Two walls of 30 m with recesses of 0.9 m by 0.12 m, which begin at places along x."""
    plan = FloorPlan()
    plan.add_wall((-15.0, -1.0), (15.0, -1.0), [15.0 + door for door in doors])
    plan.add_wall((15.0, 1.0), (-15.0, 1.0), [15.0 - (door + 0.9) for door in reversed(doors)])
    return np.array(plan.walls)


ALONG = [np.array((x, 0.0, turn)) for x in (-1.5, 0.0, 1.5) for turn in (0.0, np.pi)]


def test_a_place_is_found_and_its_covariance_holds_its_error():
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses = [np.array(one) for one in ((2.0, 2.0, 0.3), (3.0, 2.2, 2.0), (3.5, 1.5, -1.2), (4.0, 3.0, 3.5))]
        others = [pose + rng.normal(0.0, (0.3, 0.3, 0.3)) for pose in poses]
        here, there = (submap(room(), seen, seen[0], rng) for seen in (others, poses))
        true = planar_delta(inverse(planar_transform(*poses[0])) @ planar_transform(*others[0]))
        guess, box = true + rng.uniform(-1.0, 1.0, 3) * (0.8, 0.8, 0.15), np.array((1.5, 1.5, 0.3))
        [best, *rivals] = search_place(here, there, guess, np.diag((box / 3.0) ** 2), box, looks=LOOKS).modes
        assert best.log_odds > 5.0 and all(one.log_odds < -3.0 for one in rivals)
        error = best.pose - true
        errors.append(float(error @ np.linalg.solve(best.covariance, error)))
        assert np.linalg.norm(error[:2]) < 0.01  # a fifth of a cell
    assert np.mean(errors) < 3.0  # what one cell cannot tell is stated; submaps of real drives are warped by as much


def test_bounds_lose_nothing():
    """The best of all motions on the finest grid is what branch and bound finds."""
    rng = np.random.default_rng(5)
    looked = [[np.array((2.0, y, 0.4)), np.array((3.0, y, 2.4))] for y in (2.0, 2.3)]
    here, there = (submap(room(), poses, poses[0], rng) for poses in looked)
    box = np.array((0.6, 0.6, 0.1))
    found = search_place(here, there, np.zeros(3), np.diag((1e-1, 1e-1, 1e-2)), box, looks=LOOKS)
    turn = CELL_M / max(here.radius, there.radius)
    axes = [CELL_M * (np.arange(-16, 17) + 0.5) for _ in range(2)] + [turn * np.arange(-10, 11)]
    every = np.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), dtype=np.float64)
    values = evidence_at(here, there, every)
    inside = np.all(np.abs(every) <= box + np.array((0.0, 0.0, turn)), axis=1)
    assert found.modes[0].evidence == pytest.approx(values[inside].max(), abs=0.5)


def test_a_maximum_at_the_edge_of_the_box_is_looked_for_beyond_it():
    rng, poses = np.random.default_rng(6), [np.array((2.0, 2.0, 0.3)), np.array((3.0, 2.2, 2.0))]
    here, there = (submap(room(), poses, poses[0], rng) for _ in range(2))
    box = np.array((0.5, 0.5, 0.1))
    found = search_place(here, there, np.array((0.6, 0.2, 0.0)), np.diag((box / 2.0) ** 2), box, looks=LOOKS)
    assert found.reach[0] > box[0] and not found.is_at_edge
    np.testing.assert_allclose(found.modes[0].pose, 0.0, atol=0.03)


def test_along_a_bare_corridor_the_mode_is_as_long_as_the_box():
    rng = np.random.default_rng(7)
    here, there = (submap(corridor([]), ALONG, np.zeros(3), rng) for _ in range(2))
    box = np.array((2.0, 1.0, 0.1))
    found = search_place(here, there, np.zeros(3), np.diag((box / 3.0) ** 2), box, looks=LOOKS)
    assert 0.3 < np.sqrt(found.modes[0].covariance[0, 0]) < 0.5  # of the box 1.15 m, by nine looks for a witness


@pytest.mark.parametrize("shift", [0.0, 1.7])
def test_doors_at_equal_distances_leave_several_places(shift: float):
    """A row of doors 2.4 m apart, seen again: 2.4 m on it looks the same, so none of them is beyond doubt."""
    rng, walls = np.random.default_rng(8), corridor([-12.0 + 2.4 * k for k in range(10)])
    here, there = (submap(walls, ALONG, np.zeros(3), rng) for _ in range(2))
    box = np.array((4.0, 0.6, 0.1))
    found = search_place(here, there, np.array((shift, 0.0, 0.0)), np.diag((4.0, 0.1, 0.01)), box, looks=LOOKS)
    assert len(found.modes) >= 3 and found.modes[0].log_odds < 6.9
    places = sorted(float(mode.pose[0]) for mode in found.modes[:3])
    np.testing.assert_allclose(np.diff(places), 2.4, atol=0.2)  # one of a thousandth of the best is cut beside it
    likely = sorted(float(mode.pose[0]) for mode in found.modes[:3] if mode.log_odds > -5.0)
    assert len(likely) >= 2
    np.testing.assert_allclose(np.diff(likely), 2.4, atol=0.03)


def drives() -> list[Drive]:
    """Other buildings, each from its own seed, seen without noise of wheels."""
    still, rngs = Wheels(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0), [np.random.default_rng(seed) for seed in range(5)]
    plans = [ring(rng, length_m=12.0, depth_m=8.0, doors_per_wall=2 + seed % 3) for seed, rng in enumerate(rngs)]
    return [drive_plan(plan, np.random.default_rng(k), wheels=still) for k, plan in enumerate(plans)]


def places_of(drive: Drive, count: int) -> list[PlaceView]:
    """Submaps of 5 m of way at some places of a drive."""
    views = []
    for middle in np.linspace(30, len(drive.poses) - 30, count).astype(int):
        near = [drive.poses[k] for k in range(middle - 25, middle + 26, 6)]
        poses = [np.append(pose[:2, 3], np.arctan2(pose[1, 0], pose[0, 0])) for pose in near]
        views.append(submap(drive.walls, poses, poses[4], np.random.default_rng(int(middle))))
    return views


def test_a_place_in_another_building_is_no_loop():
    """Odds of x to 1 for a place that is none come up at most once in x comparisons; of 120 none has 1000 to 1."""
    views = [places_of(drive, 4) for drive in drives()]
    box, odds = np.array((1.5, 1.5, 0.2)), []
    for i, mine in enumerate(views):
        for others in views[:i]:
            for here in mine[:3]:
                for there in others:
                    found = search_place(here, there, np.zeros(3), np.diag((box / 3.0) ** 2), box, looks=LOOKS)
                    odds.append(found.modes[0].log_odds if found.modes else -np.inf)
    assert len(odds) == 120 and max(odds) < -np.log(1e-3)
    for likely in (3.0, 20.0):
        assert np.mean(np.array(odds) > np.log(likely)) < 1.0 / likely


def test_looks_below_one_are_refused():
    view = submap(room(), [np.array((2.0, 2.0, 0.0))], np.zeros(3), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"looks: expected at least 1, got 0\.5"):
        search_place(view, view, np.zeros(3), np.eye(3), np.ones(3), looks=0.5)
