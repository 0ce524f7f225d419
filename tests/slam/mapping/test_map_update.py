"""A keyframe enters: which planes start a landmark, late matches, when to look again, and what returns add to lines."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from shapely import Polygon, box

from factors.association.observations import LineObservation, PlaneObservation
from slam import Keyframe, PlaneSlam, SlamConfig
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import motion_covariance
from slam.config import LandmarkConfig
from slam.frontend.information import inverted
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from slam.mapping.map_update import bends, may_start
from spplanes import Plane, ScanLine, fit_plane
from spplanes._check import FloatArray
from tests.slam.scenes import drive, run_of


def wall(distance_m: float, sigma_m: float) -> PlaneObservation:
    """Two metres of wall ahead, a hundred points with noise that makes its middle known so well."""
    y, z = np.meshgrid(np.linspace(-1.0, 1.0, 10), np.linspace(-1.0, 1.0, 10))
    points = np.column_stack((np.full(100, distance_m), y.ravel(), z.ravel()))
    plane = fit_plane(points, sigma=10.0 * sigma_m)
    seen = PlaneObservation(Plane(plane.frame, plane.covariance, plane.n_points))
    assert seen.sigma_m == pytest.approx(sigma_m, rel=0.01)
    return seen


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.6, -0.8, 0.0)])
def test_a_turn_bends_what_it_moves_by_more_than_a_sigma_to_second_order(axis: tuple[float, float, float]) -> None:
    """Of a wall at 5 m a turn of 0.02 rad leaves 5 (1 - cos 0.02) = 1.0 mm out."""
    turn = gtsam.Rot3.Expmap(0.02 * np.array(axis)).matrix()
    assert bends(turn, [wall(5.0, 0.0009)]) and not bends(turn, [wall(5.0, 0.0011)])
    assert bends(turn, [wall(5.0, 0.0011), wall(8.0, 0.0015)])
    assert not bends(np.eye(3), [wall(5.0, 1e-5)]) and not bends(turn, [])


def seen(area_m2: float, n_points: int, tilt_sigma_rad: float) -> PlaneObservation:
    side = 0.5 * np.sqrt(area_m2)
    covariance = np.diag([1e-6, tilt_sigma_rad**2, (0.5 * tilt_sigma_rad) ** 2])
    return PlaneObservation(Plane(np.eye(4), covariance, n_points, box(-side, -side, side, side)))


@pytest.mark.parametrize(
    ("area_m2", "n_points", "tilt_sigma_rad", "may"),
    [
        pytest.param(0.3, 40, 0.09, True, id="large"),
        pytest.param(0.3, 20, 0.01, False, id="large, few points"),
        pytest.param(0.3, 500, 0.11, False, id="large, any tilt"),
        pytest.param(0.12, 260, 0.013, True, id="half a lamp"),
        pytest.param(0.12, 180, 0.013, False, id="half a lamp, far"),
        pytest.param(0.12, 260, 0.03, False, id="strip of a board"),
        pytest.param(0.09, 260, 0.013, False, id="edge"),
    ],
)
def test_a_landmark_starts_with_a_plane_that_is_large_or_very_sure(area_m2, n_points, tilt_sigma_rad, may):
    assert may_start(seen(area_m2, n_points, tilt_sigma_rad), LandmarkConfig()) is may


#: Whether a plane starts a landmark: a tilt of 0.2 rad is more than LandmarkConfig.max_tilt_sigma_rad.
UNCERTAIN = np.diag([0.01, 0.2, 0.2]) ** 2


def run(shift_m: float = 0.0, outline: Polygon | None = None, config: SlamConfig | None = None) -> PlaneSlam:
    """A drive whose first keyframe knows its last plane badly, moved along its normal, with an outline of its own."""
    frames: list[Keyframe] = drive(0, count=4).keyframes
    *seen, last = frames[0].observations
    frame = last.plane.frame.copy()
    frame[:3, 3] += shift_m * last.plane.normal
    uncertain = Plane(frame, UNCERTAIN, last.plane.n_points, outline or last.plane.outline)
    frames[0] = replace(frames[0], observations=[*seen, PlaneObservation(uncertain)])
    return run_of(frames, PlaneSlam(config))


def sightings(slam: PlaneSlam) -> list[int]:
    """Keyframes that saw the landmark born last."""
    return [one.keyframe for one in list(slam.landmarks)[-1].sightings]


def test_a_plane_too_uncertain_to_start_a_landmark_is_matched_once_it_is_there():
    slam = run()
    assert len(slam.landmarks) == 6 and sightings(slam) == [1, 0, 2, 3]
    [late] = slam.late_matches
    assert (late.at, late.keyframe, late.decision.observation) == (1, 0, 5)
    assert late.decision.match is not None and late.decision.match.chi2 < 16.3
    # its factor is in the graph: the batch of the same graph agrees
    assert slam.backend.values.size() == slam.optimize_batch().size()


def test_what_lies_elsewhere_or_is_the_edge_of_something_is_not():
    assert sightings(run(shift_m=0.3)) == sightings(run(outline=box(0.0, 0.0, 0.3, 0.3))) == [1, 2, 3]


def test_nothing_waits_longer_than_it_is_told_to():
    assert sightings(run(config=SlamConfig.model_validate({"landmarks": {"waiting_keyframes": 0}}))) == [1, 2, 3]


#: Standard deviations of (x, y, heading) by wheels and by returns, and of a line: direction rad, shift m.
WHEELS, RETURNS = np.array([0.1, 0.1, 0.05]), np.array([0.01, 0.01, 0.004])
LINE = np.array([0.002, 0.005])


def wall_ahead(ahead: float, side: float) -> LineObservation:
    """A wall of 3 m across the way, its middle so far ahead and so far to the left."""
    ends, turn = np.array([[ahead, side - 1.5], [ahead, side + 1.5]]), np.array([[1.0, 0.0], [side, 1.0]])
    line = ScanLine(0.0, ahead, turn @ np.diag(LINE**2) @ turn.T, ends, np.arange(40))
    return LineObservation(line, np.eye(4))


def after_a_step(first: list[LineObservation], second: list[LineObservation]) -> FloatArray:
    """Information of (x, y, theta) of half a metre ahead, by wheels, returns and lines, shape (3, 3)."""
    step, told = planar_transform(0.5, 0.0, 0.0), np.diag(RETURNS**2)
    motion = Motion(step, np.diag(WHEELS**2), (1e-3, 1e-3, 1e-3), returns_a_T_b=step, returns_covariance=told)
    slam = PlaneSlam()
    slam.add_keyframe(Keyframe(0, first))
    slam.add_keyframe(Keyframe(1, second, motion))
    keys = [pose_symbol(0), pose_symbol(1)]
    a_T_b = inverse(slam.backend.pose(keys[0])) @ slam.backend.pose(keys[1])
    return inverted(motion_covariance(a_T_b, slam.backend.joint_covariance(keys).of(keys)))


BY_ALL = np.diag(WHEELS**-2.0 + RETURNS**-2.0)


@pytest.mark.parametrize("seen", [[], [wall_ahead(4.0, 8.0)]], ids=["no lines", "a line of a wall that nobody knows"])
def test_returns_count_in_full_where_no_line_was_matched(seen: list[LineObservation]) -> None:
    np.testing.assert_allclose(after_a_step([wall_ahead(6.0, 0.0)], seen), BY_ALL, rtol=0.02, atol=1e-6)


def test_a_matched_line_takes_its_share_of_what_the_returns_say() -> None:
    told = after_a_step([wall_ahead(6.0, 0.0)], [wall_ahead(5.5, 0.0)])
    twice = LINE[1] ** -2.0 / 2.0  # seen from both ends
    once = WHEELS[0] ** -2.0 + max(RETURNS[0] ** -2.0, twice)
    assert told[0, 0] == pytest.approx(once, rel=0.05)  # counted twice it would be half as much again
    assert told[0, 0] > WHEELS[0] ** -2.0 + 0.5 * twice  # the line itself counts
    assert told[1, 1] == pytest.approx(BY_ALL[1, 1], rel=0.05)  # along the wall the returns speak alone
