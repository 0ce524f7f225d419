"""Scans laid on what was seen before by all their returns: where planes leave a direction open, edges hold it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from slam.config import SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.frontend.odometry import NO_FLOOR, Motion
from slam.frontend.scan_surfaces import ON_EDGE, ON_NO_PLANE, ON_PLANE, moved
from slam.geometry.frames import inverse
from slam.registration.plane_registration import negative_log_prior
from slam.registration.relocalization import (
    NO_RIVALS,
    _may_be_unseen,
    _on,
    _rivals,
    is_after_gap,
    register_from_hypotheses,
    scan_of,
)
from slam.registration.surface_registration import (
    Correspondences,
    Expected,
    LocalMap,
    Residuals,
    Tried,
    _log_likelihood,
    _number_of_things,
    align,
)
from slam.registration.visibility import Scan
from slam.simulation import simulate_mission
from tests.slam.depth_scenes import looking, measured, with_widths
from tests.spplanes.scenes import spun

FIRST = looking(-1.5, 0.0, 1.2, 0.0, 0.6)
#: 10 cm to the side, along the one direction that floor, top and side leave open, and turned by 3 deg.
SECOND = looking(-1.5, 0.1, 1.22, 0.05, 0.62)
FIRST_T_SECOND = inverse(FIRST) @ SECOND


def scan(elements: np.ndarray, viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scan:
    return Scan(with_widths(elements), np.array(viewpoint))


def surfaces_of(seed: int, *poses: np.ndarray) -> list[np.ndarray]:
    """The surface elements that a camera sees of the scene from poses, one after another."""
    rng = np.random.default_rng(seed)
    return [surfaces for pose in poses if (surfaces := measured(pose, rng).surfaces) is not None]


def off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Logmap(gtsam.Pose3(inverse(found) @ true))


def test_edges_hold_the_direction_that_the_planes_leave_open() -> None:
    known, seen = surfaces_of(0, FIRST, SECOND)
    found = align(scan(seen), LocalMap([(np.eye(4), scan(known))]), [np.eye(4)])
    assert np.linalg.norm(off(found.known_T_seen, FIRST_T_SECOND)[3:]) < 0.01
    planes = [one[one[:, 7] == ON_PLANE] for one in (known, seen)]
    bare = align(scan(planes[1]), LocalMap([(np.eye(4), scan(planes[0]))]), [np.eye(4)])
    along = SECOND[:3, :3].T @ np.array([0.0, 1.0, 0.0])
    by_all, by_planes = (
        np.sqrt(along @ np.linalg.inv(one.information + 1e-6 * np.eye(6))[3:, 3:] @ along) for one in (found, bare)
    )
    assert by_all < 0.02 and by_planes > 10.0 * by_all


def test_a_wrong_place_scores_less_than_the_right_one() -> None:
    known, seen = surfaces_of(1, FIRST, SECOND)
    there = LocalMap([(np.eye(4), scan(known))])
    right = align(scan(seen), there, [FIRST_T_SECOND])
    for aside in (1.25, 1.5):  # from nearer a descent finds back
        wrong = FIRST_T_SECOND.copy()
        wrong[:3, 3] += FIRST[:3, :3].T @ np.array([0.0, aside, 0.0])
        found = align(scan(seen), there, [wrong])
        assert np.linalg.norm(off(found.known_T_seen, FIRST_T_SECOND)[3:]) > 0.2
        assert right.score > found.score + 0.05


def wall(y: float, range_m: float, half: float, step: float) -> np.ndarray:
    """Elements of a wall facing the sensor, `half` wide to both sides of y, m."""
    y_, z_ = np.meshgrid(np.arange(y - half, y + half, step), np.arange(-half, half, step))
    points = np.column_stack((np.full(y_.size, range_m), y_.ravel(), z_.ravel()))
    towards = np.tile((-1.0, 0.0, 0.0), (len(points), 1))
    return np.column_stack((points, towards, np.full(len(points), 0.003), np.full(len(points), ON_PLANE)))


def test_a_score_counts_things_not_elements() -> None:
    known, here = LocalMap([(np.eye(4), scan(wall(0.0, 4.0, 2.0, 0.24)))]), [np.eye(4)]
    alone = align(scan(wall(0.0, 4.0, 2.0, 0.24)), known, here)
    half = align(scan(wall(0.0, 4.0, 1.4, 0.24)), known, here)
    assert half.score == pytest.approx(alone.score, rel=0.02)
    assert 1.35 < alone.weight / half.weight < 1.5  # twice as much of a plane says as the root of it
    nowhere = replace(alone, score=0.0)
    assert alone.log_odds(nowhere) / half.log_odds(nowhere) == pytest.approx(alone.weight / half.weight, rel=0.03)
    with_person = align(scan(np.vstack((wall(0.0, 4.0, 2.0, 0.24), wall(0.0, 1.0, 0.2, 0.03)))), known, here)
    assert with_person.share < 0.7  # before a camera who walks by close is a third of all that is seen
    assert with_person.score > 0.7 * alone.score > 0.5  # and one thing


def test_the_floor_of_a_room_does_not_outvote_all_that_stands_on_it() -> None:
    x, y = np.meshgrid(np.arange(1.5, 5.0, 0.15), np.arange(-2.0, 2.0, 0.15))
    floor = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, -1.0), np.zeros((x.size, 2)), np.ones(x.size)))
    floor = np.column_stack((floor, np.full(len(floor), 0.003), np.full(len(floor), ON_PLANE)))
    # five faces that are no one's plane but their own, each a twentieth of the floor
    faces = [wall(side, 2.0 + 0.5 * k, 0.3, 0.1) for k, side in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0))]
    known = LocalMap([(np.eye(4), scan(np.vstack((floor, *faces))))])
    lower, elsewhere = floor + np.eye(8)[2] * -0.02, [face + np.eye(8)[0] * 0.4 for face in faces]
    assert _score_of(np.vstack((lower, *faces)), known) > _score_of(np.vstack((floor, *elsewhere)), known) + 0.2


def _score_of(seen: np.ndarray, known: LocalMap) -> float:
    """Score of a scan where it stands, not where it would come to rest."""
    return align(scan(seen), known, [np.eye(4)], Expected(np.eye(4), 1e12 * np.eye(6))).score


def elements(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """True elements of three surfaces and clutter, and the same as measured."""
    points = rng.uniform((2.0, -2.0, -2.0), (6.0, 2.0, 2.0), (900, 3))
    normals = np.eye(3)[rng.integers(0, 3, 900)]
    kinds = rng.choice([ON_PLANE, ON_NO_PLANE, ON_EDGE], 900, p=[0.6, 0.3, 0.1])
    true = np.column_stack((points, normals, np.full(900, 1e-9), kinds.astype(float)))
    seen = true.copy()
    seen[:, :3] += normals * (sigma * rng.standard_normal(900))[:, None]
    seen[:, 6] = sigma
    return true, seen


def test_the_stated_covariance_is_what_the_error_has() -> None:
    rng, nees, beyond = np.random.default_rng(2), [], []
    for _ in range(60):
        true, seen = elements(rng, 0.005)
        motion = gtsam.Pose3.Expmap(rng.normal(0.0, (0.01, 0.01, 0.01, 0.02, 0.02, 0.02))).matrix()
        found = align(scan(moved(seen, inverse(motion))), LocalMap([(np.eye(4), scan(true))]), [np.eye(4)])
        error = off(found.known_T_seen, motion)
        nees.append(error @ found.information @ error)
        information, told = found.residuals.told_by(seen[:, 7] != ON_PLANE)
        rest = np.linalg.solve(information, told) - error
        beyond.append(rest @ information @ rest)
    high = chi2.ppf(0.9995, 6 * 60) / 60
    assert 0.6 * 6 < np.mean(nees) < high  # the kernel takes a fifth of the information of what is good
    assert 0.6 * 6 < np.mean(beyond) < high


def test_residuals_have_the_derivative_that_they_say() -> None:
    true, seen = elements(np.random.default_rng(3), 0.005)
    known, motion = LocalMap([(np.eye(4), scan(true))]), gtsam.Pose3.Expmap(np.full(6, 0.003)).matrix()
    reach = np.full(len(seen), 0.3)
    here = Residuals.of(Correspondences(with_widths(seen), known), motion, reach)
    for k in range(6):
        step = gtsam.Pose3.Expmap(1e-6 * np.eye(6)[k]).matrix()
        there = Residuals.of(Correspondences(with_widths(seen), known), motion @ step, reach)
        np.testing.assert_array_equal(there.index, here.index)
        np.testing.assert_allclose((there.off - here.off) / 1e-6, here.jacobian[:, k], atol=1e-4)


@pytest.mark.parametrize("step_m", [1e-4, 0.01, 0.5])
def test_nearest_elements_are_the_nearest_after_every_step(step_m: float) -> None:
    rng = np.random.default_rng(4)
    true, seen = elements(rng, 0.005)
    true[::9, 7] = seen[::7, 7] = ON_EDGE
    known = LocalMap([(np.eye(4), scan(true))])
    scan_laid, points = Correspondences(with_widths(seen), known), seen[:, :3].copy()
    for reach_m in (0.5, 0.5, 0.2, 0.1):
        points += rng.normal(0.0, step_m, 3)
        apart = np.linalg.norm(points[:, None] - known.elements[:, :3], axis=2)
        apart[(seen[:, 7] == ON_EDGE)[:, None] != (known.elements[:, 7] == ON_EDGE)] = np.inf
        found = scan_laid.nearest(points, np.full(len(seen), reach_m))
        near = apart.min(axis=1) < reach_m
        assert near.any()
        np.testing.assert_array_equal(found[near], apart.argmin(axis=1)[near])
        assert np.all(apart[~near, found[~near]][found[~near] >= 0] >= reach_m)


#: A camera a metre above the origin of its body.
EYE = (0.1, 0.0, 1.0)


def corridor(world_T_body: np.ndarray, *, end_m: float = np.inf) -> Scan:
    """Elements of a corridor along x, 2 m wide and 2.5 m high, from a camera that looks ahead and 5 m far."""
    v, u = np.mgrid[-0.4:0.41:0.05, -0.55:0.56:0.05]
    rays = np.stack([np.ones_like(u), u, v], axis=-1).reshape(-1, 3) @ world_T_body[:3, :3].T
    eye = world_T_body[:3, :3] @ EYE + world_T_body[:3, 3]
    normals, d = np.vstack([np.eye(3), -np.eye(3)])[[1, 4, 2, 5, 3]], np.array([-1.0, -1.0, 0.0, -2.5, -end_m])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(rays @ normals.T < 0.0, (d - eye @ normals.T) / (rays @ normals.T), np.inf)
    first, seen = reach.argmin(axis=1), reach.min(axis=1) < 5.0
    points = eye + reach.min(axis=1)[seen, None] * rays[seen]
    rows = np.column_stack((points, normals[first[seen]], np.full(seen.sum(), 0.003), np.zeros(seen.sum())))
    return scan(moved(rows, inverse(world_T_body)), EYE)


def ahead(metres: float, turn: float = 0.0) -> np.ndarray:
    return gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.array([metres, 0.0, 0.0])).matrix()


def test_nothing_is_seen_through_from_the_true_place_wherever_the_sensor_sits() -> None:
    known = corridor(np.eye(4))
    for metres, turn in ((0.25, 0.0), (0.5, 0.0), (1.25, 0.0), (0.25, 0.4)):
        known_T_seen = ahead(metres, turn)
        seen = corridor(known_T_seen)
        for sight, elements in (
            (known, moved(seen.elements, known_T_seen)),
            (seen, moved(known.elements, inverse(known_T_seen))),
        ):
            assert _number_of_things(elements[sight.through(elements[:, :3]), :3]) <= 1


@pytest.mark.parametrize("metres", [0.0, 0.5])
def test_somebody_close_by_speaks_against_a_place_as_one_thing(metres: float) -> None:
    """A third of the image; a board across the corridor is several."""
    behind, empty = corridor(ahead(metres), end_m=4.0), LocalMap([(np.eye(4), corridor(np.eye(4), end_m=4.0))])
    body = np.stack(np.meshgrid(0.8, np.linspace(-0.2, 0.2, 12), np.linspace(0.8, 1.2, 22)), axis=-1).reshape(-1, 3)
    board = np.stack(np.meshgrid(2.0, np.linspace(-0.9, 0.9, 12), np.linspace(0.3, 1.7, 22)), axis=-1).reshape(-1, 3)
    told = []
    for points in (body, board):
        facing = np.tile((-1.0, 0.0, 0.0, 0.003, ON_NO_PLANE), (len(points), 1))
        alone = with_widths(np.hstack((points, facing)))
        seen = scan(np.vstack((behind.elements, alone)), EYE)
        told.append(float(empty.contradicted(ahead(metres), alone, seen)[0]) * seen.weights.sum())
    assert len(body) > 0.25 * len(behind.elements) and told[0] == pytest.approx(1.0) and told[1] >= 4.0


def test_what_any_keyframe_saw_through_speaks_against_a_place() -> None:
    """A board along the side of a corridor, that the newest keyframe, farther back, looked away from."""
    aside = ahead(-3.0, np.pi / 2)
    known = LocalMap([(np.eye(4), corridor(np.eye(4))), (aside, corridor(aside))])
    x, y, z = np.meshgrid(np.linspace(2.0, 3.0, 12), 0.7, np.linspace(0.6, 1.8, 15))
    board = np.column_stack((x.ravel(), y.ravel(), z.ravel()))
    board = with_widths(np.hstack((board, np.tile((0.0, -1.0, 0.0, 0.003, ON_NO_PLANE), (len(board), 1)))))
    seen = Scan(np.vstack((corridor(ahead(1.5)).elements, board)), EYE)
    older, newest = known.contradicted(np.eye(4), board, seen)
    assert newest == known.contradicted(np.eye(4), board, seen, latest=1) == 0.0 < older
    found = align(seen, known, [np.eye(4), ahead(1.5)])
    np.testing.assert_allclose(found.known_T_seen, ahead(1.5), atol=0.01)  # walls have more in common where it started


def test_a_camera_that_turned_by_more_than_a_descent_finds_back_from_is_found() -> None:
    turned = gtsam.Pose3(gtsam.Rot3.Yaw(0.35), np.array([0.02, 0.03, 0.0])).matrix()
    known, seen = surfaces_of(3, FIRST, FIRST @ turned)
    there = LocalMap([(np.eye(4), scan(known))])
    expected = Expected(np.eye(4), np.diag(np.repeat([0.3, 0.2], 3) ** -2.0))
    found = register_from_hypotheses(scan(seen), there, None, expected, np.eye(4))
    assert np.linalg.norm(off(found.known_T_seen, turned)[3:]) < 0.01
    assert np.linalg.norm(off(align(scan(seen), there, [np.eye(4)], expected).known_T_seen, turned)[3:]) > 0.1


def test_what_stands_before_a_surface_that_was_seen_is_seen_through() -> None:
    sight = corridor(np.eye(4), end_m=4.0)
    post = np.column_stack((np.full(20, 2.0), np.full(20, 0.1), np.linspace(0.6, 1.4, 20)))
    assert sight.through(post).all()
    assert not sight.through(post + np.array([1.99, 0.0, 0.0])).any()  # on the wall at the end
    assert not sight.through(post + np.array([3.0, 0.0, 0.0])).any()  # behind it


def test_along_what_the_returns_leave_open_a_scan_stays_where_it_is_expected() -> None:
    seen, known, guess = corridor(ahead(0.5)), LocalMap([(np.eye(4), corridor(np.eye(4)))]), ahead(0.6)
    guess[1, 3] = 0.1
    expected = Expected(guess, np.diag(np.repeat([0.2, 0.3], 3) ** -2.0))
    for start in (guess, np.eye(4)):
        found = align(seen, known, [start], expected).known_T_seen
        np.testing.assert_allclose(found[:3, 3], (0.6, 0.0, 0.0), atol=0.01)


def test_elements_are_told_by_the_planes_that_they_lie_on() -> None:
    seen = measured(FIRST, np.random.default_rng(4))
    assert seen.surfaces is not None
    on_plane = seen.surfaces[:, 7] == ON_PLANE
    np.testing.assert_array_equal(_on(seen.surfaces, seen.observations), on_plane)
    assert 0 < _on(seen.surfaces, seen.observations[:1]).sum() < on_plane.sum() and not _on(seen.surfaces, []).any()


@pytest.mark.parametrize("seed", range(3, 7))
def test_pillars_are_found_from_further_off_than_walls_are_uneven(seed: int) -> None:
    """Hundreds of elements on floor and walls are close wherever along the hall the scan is laid; few tell where."""
    mission = simulate_mission("hall", n_scans=2, seed=seed)
    first, second = keyframes_of(mission.log, mission.rig, SlamConfig())
    known, seen = scan_of(first), scan_of(second)
    assert known is not None and seen is not None
    world_T_first, world_T_second = mission.truth.poses_at(np.array([first.stamp_ns, second.stamp_ns]))
    true = inverse(world_T_first) @ world_T_second
    assert 0.4 < np.linalg.norm(true[:3, 3]) < 0.6
    found = align(seen, LocalMap([(np.eye(4), known)]), [np.eye(4)])
    assert np.linalg.norm(off(found.known_T_seen, true)[3:]) < 0.01


def pillared(x: float, pillars: int = 1) -> Scan:
    """Elements that a scanner of sixteen rings has of a long hall with a pillar or none, 1.2 m above its floor, m."""
    rays = spun(np.deg2rad(np.linspace(-15.0, 15.0, 16)), np.deg2rad(np.arange(0.0, 360.0, 3.0)))
    rays = rays.swapaxes(0, 1).reshape(-1, 3)
    eye, middle = np.array([x, 0.0, 1.2]), np.array([0.0, 0.0, 2.0])
    best, normals = np.full(len(rays), np.inf), np.zeros_like(rays)
    boxes = [(middle, (100.0, 5.0, 2.0)), (np.array([2.3, -3.0, 2.0]), (0.3, 0.3, 2.0))]
    for k, (centre, half) in enumerate(boxes[: 1 + pillars]):
        with np.errstate(divide="ignore"):
            near, far = np.sort([(centre + side * np.array(half) - eye) / rays for side in (-1.0, 1.0)], axis=0)
        axis = far.argmin(axis=1) if k == 0 else near.argmax(axis=1)  # the hall is seen from inside, the pillar is not
        reach = far.min(axis=1) if k == 0 else near.max(axis=1)
        met = (reach > 0.0) & (reach < best) & ((k == 0) | (reach < far.min(axis=1)))
        best[met], normals[met] = reach[met], (-np.sign(rays) * np.eye(3)[axis])[met]
    chosen = best < 20.0
    points = (best[:, None] * rays)[chosen]
    return scan(np.column_stack((points, normals[chosen], np.full(len(points), 0.003), np.zeros(len(points)))))


def test_beams_that_move_with_the_sensor_do_not_say_that_nothing_moved() -> None:
    true = ahead(2.0)
    seen, known = pillared(2.0), LocalMap([(np.eye(4), pillared(0.0))])
    right, still = (align(seen, known, [start]) for start in (true, np.eye(4)))
    assert np.linalg.norm(off(still.known_T_seen, true)[3:]) > 1.5
    assert still.share > right.share + 0.1  # more of what is seen comes to lie on what was seen before
    assert right.score > still.score
    np.testing.assert_allclose(align(seen, known, [np.eye(4), true]).known_T_seen, true, atol=0.01)


def test_a_surface_goes_on_between_the_beams_but_not_across_an_edge() -> None:
    sight, wall = pillared(0.0), np.array([[1.0, 5.0, -0.15, 0.0, -1.0, 0.0, 0.003, ON_PLANE]])
    before, away, edge = wall.copy(), wall.copy(), wall.copy()
    before[:, 1] -= 0.2
    away[:, 3:6] = 0.0, 1.0, 0.0
    edge[:, 7] = ON_EDGE
    off_by = sight.off_surfaces(with_widths(np.vstack((wall, before, away, edge))))
    np.testing.assert_allclose(off_by, (0.0, 0.2, np.inf, np.inf), atol=1e-9)


def test_of_places_that_fit_alike_the_expected_one_is_taken_and_the_other_is_named() -> None:
    """A hall without a pillar, from its middle: turned on one's heel it looks the same."""
    seen, known = pillared(0.0, pillars=0), LocalMap([(np.eye(4), pillared(0.0, pillars=0))])
    heel = ahead(0.0, np.pi)
    for start, other in ((np.eye(4), heel), (heel, np.eye(4))):
        found = align(seen, known, [other, start], Expected(start, np.diag(np.repeat([0.5, 1.0], 3) ** -2.0)))
        np.testing.assert_allclose(found.known_T_seen, start, atol=1e-6)
        first, second = found.tried
        likelier_by = first.log_likelihood - second.log_likelihood
        assert likelier_by == pytest.approx(negative_log_prior(heel, (1.0, 0.5)), abs=0.2)


def test_a_place_that_fits_much_worse_does_so_in_thing_after_thing() -> None:
    """By chance one thing does; the more is seen, the less so. Places that differ by little are alike in all things."""
    little, much = (_log_likelihood(less, 100.0, np.eye(4), None) for less in (0.1, 0.4))
    assert much < 5.0 * little < 0.0
    assert _log_likelihood(0.01, 100.0, np.eye(4), None) == pytest.approx(0.1 * little, rel=0.15)


def test_rivals_are_other_places_and_each_counts_once() -> None:
    found = align(pillared(0.0), LocalMap([(np.eye(4), pillared(0.0))]), [np.eye(4)])
    first, best = found.tried[0], found.tried[0].log_likelihood
    off = [Tried(ahead(metres), best - np.log(4.0)) for metres in (5.0, 5.001)] + [Tried(ahead(0.0, 3.0), -np.inf)]
    near, covariance = Tried(ahead(0.01), best - 0.1), np.diag(np.repeat([0.02, 0.004], 3) ** 2)
    tried = replace(found, tried=(first, near, *off))
    assert _rivals(tried, covariance, 0.0) == pytest.approx((0.2, 5.0, 0.0, 0.0), abs=1e-6)
    wide = np.diag([9.0, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])  # along an open direction a place is one, however long
    assert _rivals(tried, wide, 0.0).probability == 0.0
    assert _rivals(replace(found, tried=(first, near)), covariance, 0.0) == NO_RIVALS
    alone = replace(found, tried=(first,))  # odds that none of it was seen before, after looking
    assert _rivals(alone, covariance, 0.5) == pytest.approx((1.0 / 3.0, 0.0, 0.0, 1.0 / 3.0))
    assert _rivals(tried, covariance, 1.0) == pytest.approx((1.25 / 2.25, 5.0, 0.0, 1.0 / 2.25), abs=1e-6)


def test_what_was_never_seen_may_be_seen_where_a_body_may_be_beyond_what_it_sees() -> None:
    elements = np.zeros((3, 9))
    elements[:, 0] = 1.0, 3.0, 50.0  # half of it 3 m away or nearer
    odds = [
        _may_be_unseen(elements, Motion(np.eye(4), np.diag([sigma**2] * 3 + [1.0] * 3), NO_FLOOR))
        for sigma in (1.0, 3.0, 30.0)
    ]
    assert [is_after_gap(late) for late in ([0], [0, 9], [0, 1, 2, 4], [0, 1, 2, 5], [0, 3, 4, 5, 8])] == [
        *(False, False, False, True, True)
    ]
    np.testing.assert_allclose(odds, [0.0027 / 0.9973, 0.3173 / 0.6827, 0.9203 / 0.0797], rtol=1e-3, atol=0.0)
