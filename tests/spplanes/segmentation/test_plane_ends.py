"""The ends of a window's planes: returns that may be of something else bend no plane."""

import numpy as np
import pytest

from spplanes import Plane, fit_plane
from spplanes.segmentation.validation.plane_ends import Window, sure_points
from spplanes.segmentation.validation.splitting import tells_tilt
from tests.statistics import assert_mean_in_band, mean_nees_band

SCANS, NOISE_M, RUNS = 18, 0.015, 60
WALL_M = 1.1
#: A laser sees a wall beside it and what is above.
BEAMS = np.deg2rad(np.arange(-30.0, 85.0, 0.5))
NOTHING = np.zeros((6 * SCANS, 6 * SCANS))
#: Every beam is of the wall.
ALL_WALL = np.zeros((SCANS, len(BEAMS)), dtype=np.int32)


def facing(normal: list[float], d: float) -> Plane:
    return Plane.from_hesse(normal, d, np.zeros((3, 3)))


TO_WALL, WALL = WALL_M / np.cos(BEAMS), facing([0.0, -1.0, 0.0], -WALL_M)


def view_of(reach: np.ndarray, seed: int) -> Window:
    """Points of beams that reach so far, (B,) m, with the noise of their ranges."""
    directions = np.stack((np.zeros_like(BEAMS), np.cos(BEAMS), np.sin(BEAMS)), axis=1)
    ranges = reach + np.random.default_rng(seed).normal(0.0, NOISE_M, (SCANS, len(BEAMS)))
    points = ranges[..., None] * directions
    points[..., 0] += 0.027 * np.arange(SCANS)[:, None]
    covariances = NOISE_M**2 * np.einsum("bi,bj->bij", directions, directions)
    return Window(points, np.broadcast_to(covariances, (*points.shape[:2], 3, 3)), NOTHING)


def nearest(view: Window, planes: list[Plane]) -> np.ndarray:
    """Labels by the plane that explains a point best along its beam, -1 beyond 3.5 standard deviations."""
    off = [
        np.abs(plane.distance(view.points.reshape(-1, 3))).reshape(view.points.shape[:2])
        / np.sqrt(np.einsum("sbij,i,j->sb", view.covariances, plane.normal, plane.normal) + 1e-12)
        for plane in planes
    ]
    return np.where(np.min(off, axis=0) < 3.5, np.argmin(off, axis=0), -1)


def nees(view: Window, mask: np.ndarray, true: Plane) -> float:
    fitted = fit_plane(view.points[mask], view.covariances[mask], viewpoint=np.array([0.2, 0.0, 0.0]))
    return fitted.mahalanobis(true)


@pytest.mark.parametrize("top_m", [0.4, 0.7])
def test_a_wall_and_its_ceiling_are_as_sure_as_they_say_where_they_meet(top_m: float):
    sides = [WALL, facing([0.0, 0.0, -1.0], -top_m)]
    with np.errstate(divide="ignore"):
        to_ceiling = np.where(BEAMS > 0.0, top_m / np.abs(np.sin(BEAMS)), np.inf)
    with_seam, without = [], []
    for seed in range(RUNS):
        view = view_of(np.minimum(TO_WALL, to_ceiling), seed)
        labels = nearest(view, sides)
        sure = sure_points(view, labels, [side.frame for side in sides], 0.0)
        assert np.all(labels[sure] >= 0)
        with_seam += [nees(view, labels == k, side) for k, side in enumerate(sides)]
        without += [nees(view, sure & (labels == k), side) for k, side in enumerate(sides)]
    assert_mean_in_band(without, 3)
    assert np.mean(with_seam) > mean_nees_band(2 * RUNS, 3)[1]


def test_a_row_of_something_that_was_not_found_bends_no_wall():
    edge = len(BEAMS) // 2
    reach = TO_WALL.copy()
    reach[edge] += 0.03 / np.cos(BEAMS[edge])  # the soffit of a door
    reach[edge + 1 :] += 0.5  # the room behind
    labels = np.where(np.arange(len(BEAMS)) <= edge, 0, -1) * np.ones((SCANS, 1), dtype=np.int32)
    with_row, without = [], []
    for seed in range(RUNS):
        view = view_of(reach, seed)
        sure = sure_points(view, labels, [WALL.frame], 0.0)
        with_row.append(nees(view, labels == 0, WALL))
        without.append(nees(view, sure, WALL))
    assert_mean_in_band(without, 3)
    assert np.mean(with_row) > 1.5 * mean_nees_band(RUNS, 3)[1]


def test_planes_that_nothing_adjoins_keep_their_points():
    view, labels = view_of(TO_WALL, 0), ALL_WALL.copy()
    across = facing([0.0, 0.0, -1.0], -0.5)  # a plane that no point is of
    assert sure_points(view, labels, [WALL.frame, across.frame], 0.0).all()
    silent = view.points.copy()
    silent[:, 100:] = np.nan  # glass: no return says that the wall ends there
    labels[:, 100:] = -1
    sure = sure_points(Window(silent, view.covariances, NOTHING), labels, [WALL.frame], 0.0)
    np.testing.assert_array_equal(sure, labels == 0)


def test_a_board_before_its_wall_ends_where_the_wall_begins():
    reach, labels = TO_WALL.copy(), ALL_WALL.copy()
    reach[60:90] -= 0.02 / np.cos(BEAMS[60:90])
    labels[:, 60:90] = 1
    board = facing([0.0, -1.0, 0.0], 0.02 - WALL_M)
    sure = sure_points(view_of(reach, 0), labels, [WALL.frame, board.frame], 0.0)
    np.testing.assert_array_equal(np.flatnonzero(~sure.all(axis=0)), [59, 60, 89, 90])


def test_a_wall_ends_between_two_scans_as_between_two_beams():
    labels = ALL_WALL.copy()
    labels[:5] = -1
    sure = sure_points(view_of(TO_WALL, 0), labels, [WALL.frame], 0.0)
    np.testing.assert_array_equal(sure, np.arange(SCANS)[:, None] * np.ones(len(BEAMS)) > 5)


@pytest.mark.parametrize(("uneven_m", "are_sure"), [(0.0, True), (0.0025, False)])
def test_where_a_beam_grazes_a_plane_that_it_is_uneven_moves_the_place(uneven_m: float, are_sure: bool):
    """A floor 0.1 m below, met at a slope of 0.1: unevenness of 2.5 mm is 25 mm along the beam, 60 mm before a wall."""
    low, across = facing([0.0, 0.0, 1.0], -0.1), facing([0.0, -1.0, 0.0], -1.06)
    beam = np.array([0.0, 1.0, -0.1]) / np.hypot(1.0, 0.1)
    points = np.array([[[0.001 * k, 1.0, -0.1], [0.001 * k, 1.06, 0.0]] for k in range(3)])
    noise = np.broadcast_to(0.005**2 * np.outer(beam, beam), (3, 2, 3, 3))
    labels = np.array([[0, 1]] * 3)
    sure = sure_points(Window(points, noise, NOTHING), labels, [low.frame, across.frame], uneven_m)
    assert np.all(sure[:, 0] == are_sure)


def test_points_left_out_are_those_whose_place_on_their_plane_may_be_on_another():
    """Of noise in all directions and planes of any direction, by the formula for every point alone."""
    rng, left_out = np.random.default_rng(3), 0
    for _ in range(20):
        labels = rng.permutation(np.repeat([0, 1, 2], 12)).reshape(6, 6)
        normals, offsets = np.linalg.qr(rng.normal(size=(3, 3)))[0].T, rng.normal(0.0, 0.05, 3)
        planes = [facing(normal, d) for normal, d in zip(normals, offsets, strict=True)]
        points, roots = rng.normal(0.0, 0.3, (6, 6, 3)), 0.01 * rng.normal(size=(6, 6, 3, 3))
        noise = roots @ roots.swapaxes(-1, -2)
        sure = sure_points(Window(points, noise, NOTHING), labels, [plane.frame for plane in planes], 0.004)
        own = np.array([plane.normal for plane in planes])[labels]
        toward = np.einsum("sbij,sbj->sbi", noise, own)
        toward /= np.einsum("sbi,sbi->sb", toward, own)[..., None]
        off = np.einsum("sbi,sbi->sb", own, points) - np.array([plane.d for plane in planes])[labels]
        places = points - off[..., None] * toward
        doubtful = np.zeros(labels.shape, dtype=bool)
        for k, other in enumerate(planes):
            variance = np.einsum("i,sbij,j->sb", other.normal, noise, other.normal)
            reach = 4.0 * np.sqrt(variance + 0.004**2 * (1.0 + (toward @ other.normal) ** 2))
            local = (places - other.frame[:3, 3]) @ other.frame[:3, :2]
            low, high = local[labels == k].min(axis=0), local[labels == k].max(axis=0)
            near = ((local >= low - reach[..., None]) & (local <= high + reach[..., None])).all(axis=2)
            doubtful |= (labels != k) & near & (np.abs(places @ other.normal - other.d) <= reach)
        np.testing.assert_array_equal(sure, ~doubtful)
        left_out += int(doubtful.sum())
    assert 100 < left_out < 600


@pytest.mark.parametrize(("rows", "tells"), [(1, False), (2, False), (SCANS, True)])
def test_points_of_a_scan_or_two_do_not_tell_how_a_plane_is_turned(rows: int, tells: bool):
    view, part = view_of(TO_WALL, 0), np.arange(rows * len(BEAMS))[:: rows * len(BEAMS) // 25]
    assert tells_tilt(view, part, WALL.frame, 0.1) is tells
    assert not tells_tilt(view, part[:2], WALL.frame, 0.1)
