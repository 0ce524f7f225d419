"""What a keyframe leaves open is said by name and size, and a graph without odometry is never indeterminate."""

from dataclasses import replace
from functools import partial
from itertools import compress

import gtsam
import numpy as np
import pytest

from factors.association.observations import LineObservation, PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.config import ObservabilityConfig
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from slam.mapping.observability import name_of, open_directions, plane_information
from slam.planeslam import pose_symbol
from spplanes import Plane
from tests.factors.factor_scenes import make_line
from tests.slam.scenes import drive, measured, room_planes, run_of
from tests.statistics import central_differences

RULES = ObservabilityConfig()
ROOM_COVARIANCE = np.diag([0.004, 0.003, 0.005]) ** 2
#: Floor, ceiling and the two walls along x.
CORRIDOR = [plane for plane in room_planes() if abs(plane.normal[0]) < 0.5]


def sight(plane: Plane, covariance: np.ndarray = ROOM_COVARIANCE) -> PlaneObservation:
    return PlaneObservation(replace(plane, covariance=covariance))


def sp_error(plane: Plane, delta: np.ndarray) -> np.ndarray:
    """(z, theta, psi) of the plane as a body moved by a Pose3 tangent sees it, in the plane's frame before."""
    moved = plane.transform(inverse(gtsam.Pose3.Expmap(delta).matrix()))
    x_axis, y_axis = plane.frame[:3, 0], plane.frame[:3, 1]
    return np.array([moved.d - moved.normal @ plane.centre, x_axis @ moved.normal, -(y_axis @ moved.normal)])


def test_information_is_that_of_the_measurement_by_central_differences():
    rng = np.random.default_rng(0)
    half = rng.standard_normal((3, 3))
    covariance = half @ half.T + 0.1 * np.eye(3)  # correlated, so that a wrong sign of one row shows
    for plane in room_planes():
        seen = replace(plane, frame=gtsam.Pose3.Expmap(rng.standard_normal(6)).matrix() @ plane.frame)
        jacobian = central_differences(partial(sp_error, seen), np.zeros(6))
        expected = jacobian.T @ np.linalg.solve(covariance, jacobian)
        np.testing.assert_allclose(plane_information(sight(seen, covariance)), expected, rtol=1e-5, atol=1e-5)


def test_noisy_looks_at_one_wall_fix_nothing_along_it():
    """Two looks 3 deg apart seem to cross; by the landmark's own normal the way along the wall stays open."""
    turns = [gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.zeros(3)).matrix() for turn in (0.0, 0.05)]
    looks = [sight(plane.transform(turn)) for plane in CORRIDOR for turn in turns]
    assert not any(one.name == "along x" for one in open_directions(4, looks, np.eye(4), RULES))
    normals = [plane.normal for plane in CORRIDOR for _ in range(2)]
    (found,) = open_directions(4, looks, np.eye(4), RULES, normals=normals)
    assert (found.part, found.name, found.sigma_seen) == ("position", "along x", np.inf)


WALL = sight(room_planes()[4])
LEVEL_LINES = ((0.0, 3.0), (np.pi / 2.0, 2.0), (np.pi, 4.0), (-np.pi / 2.0, 2.0))
LEVEL = Motion(np.eye(4), np.diag([1e-4, 1e-4, 1e-4]), (0.001, 0.001, 0.001))
ROUGH, SPATIAL = replace(LEVEL, out_of_plane_sigmas=(0.5, 0.001, 0.2)), Motion(np.eye(4), np.eye(6), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("seen", "motion", "names"),
    [
        pytest.param([sight(plane) for plane in room_planes()], None, [], id="a room"),
        pytest.param([sight(room_planes()[0])], None, ["about z", "along x", "along y"], id="a floor"),
        pytest.param(
            [LineObservation(make_line(*line, np.diag([1e-5, 1e-5])), np.eye(4)) for line in LEVEL_LINES],
            None,
            ["about x", "about y", "along z"],
            id="lines of a level laser",
        ),
        pytest.param([WALL], LEVEL, ["along x"], id="a wall, on a floor"),
        pytest.param([WALL], replace(LEVEL, out_of_plane_sigmas=(0.0,) * 3), ["along x"], id="exactly"),
        pytest.param([WALL], ROUGH, ["about y", "along x", "along z"], id="on a rough floor"),
        pytest.param([WALL], SPATIAL, ["about y", "along x", "along z"], id="in space"),
        pytest.param([WALL], None, ["about y", "along x", "along z"], id="a wall"),
    ],
)
def test_what_is_seen_leaves_open_what_it_must(seen: list, motion: Motion | None, names: list[str]):
    found = open_directions(1, seen, np.eye(4), RULES, motion)
    assert sorted(one.name for one in found) == names
    assert all((one.part == "position") == one.name.startswith("along") for one in found)


def test_an_end_wall_seen_badly_is_not_nothing_and_has_its_size():
    seen = [*map(sight, CORRIDOR), sight(room_planes()[2], np.diag([0.5**2, 1.0, 1.0]))]
    (found,) = open_directions(1, seen, np.eye(4), RULES)
    assert found.sigma_seen == pytest.approx(0.5, rel=1e-3)
    assert open_directions(1, seen, np.eye(4), ObservabilityConfig(max_sigma_m=0.6)) == []


def corridor_run(*, with_odometry: bool, count: int = 8) -> PlaneSlam:
    """A drive that sees floor, ceiling and the two walls along x only."""
    frames, level = [], [abs(plane.normal[0]) < 0.5 for plane in room_planes()]
    for frame in drive(0, count=count).keyframes:
        motion = frame.motion if with_odometry else None
        frames.append(replace(frame, observations=list(compress(frame.observations, level)), motion=motion))
    return run_of(frames)


def test_a_run_says_what_only_odometry_holds_and_how_well():
    slam = corridor_run(with_odometry=True)
    (stretch,) = slam.open_directions
    assert stretch.keyframes == tuple(range(1, 8)) and stretch.total == 7
    pose, covariance = slam.trajectory.poses[-1], slam.marginal_covariance(pose_symbol(7))[3:, 3:]
    assert stretch.sigma == pytest.approx(np.sqrt((pose[:3, :3] @ covariance @ pose[:3, :3].T)[0, 0]), rel=1e-2)
    assert stretch.sentence.startswith("along x: information only from odometry at 7 of 7 keyframes, sigma 0.0")


def test_without_odometry_the_graph_stands_and_says_what_is_assumed():
    slam = corridor_run(with_odometry=False, count=4)
    along = next(stretch for stretch in slam.open_directions if stretch.sentence.startswith("along x"))
    assert "information only from the assumption of constant velocity at 3 of 3 keyframes" in along.sentence
    assert along.sigma > 0.5 and len(slam.optimize_batch().keys()) == 4 + len(slam.landmarks)


def test_a_keyframe_without_odometry_and_without_planes_is_held_by_the_assumption_alone():
    slam = run_of(Keyframe(index * 10**9, []) for index in range(3))
    assert {stretch.part for stretch in slam.open_directions} == {"position", "orientation"}
    assert np.isfinite(slam.marginal_covariance(pose_symbol(2))).all()


def test_where_nothing_is_known_of_two_directions_they_are_called_by_the_axes():
    """Seen a little askew, a wall alone leaves any direction in it open: those near the axes have names."""
    wall = next(plane for plane in room_planes() if plane.normal[1] < -0.5)
    turned = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.03, 0.05, 0.04), np.zeros(3)).matrix()
    for slanted in (np.eye(4), turned):
        seen = sight(wall.transform(inverse(turned)), np.diag([1e-4, 2e-6, 1e-6]))
        found = open_directions(1, [seen], slanted, RULES)
        assert sorted(one.name for one in found if one.part == "position") == ["along x", "along z"]


def test_a_corridor_seen_by_planes_alone_is_open_as_a_whole_along_itself():
    (found,) = corridor_run(with_odometry=False).open_in_map
    assert found.keyframes == tuple(range(1, 8)) and found.total == 7
    assert found.sentence == (
        "the map as a whole, along x: planes alone leave 7 of 7 keyframes open against the first, without bound"
    )


def test_a_room_is_fixed_as_a_whole():
    assert run_of(drive(0, count=8).keyframes).open_in_map == []


def test_two_rooms_that_only_a_bare_corridor_links_are_open_against_each_other():
    """Every keyframe at the ends is fixed by what it sees; what lies between says nothing of how far they are apart."""
    slam, rng = PlaneSlam(), np.random.default_rng(0)
    ends = [plane for plane in room_planes() if abs(plane.normal[0]) > 0.5]
    for index in range(9):
        pose = planar_transform(0.4 * index, 0.0, 0.0)
        near = [*CORRIDOR, *(ends[:1] if index < 3 else ends[1:] if index > 5 else [])]
        seen = [PlaneObservation(measured(plane.transform(inverse(pose)), rng)) for plane in near]
        step = planar_transform(0.4, 0.0, 0.0)
        motion = Motion(step, np.diag([1e-4, 1e-4, 1e-5]), (1e-3, 1e-3, 1e-3)) if index else None
        slam.add_keyframe(Keyframe(index * 10**9, seen, motion, None if index else pose))
    assert {one.keyframe for one in slam.observability.history} == {3, 4, 5, 6}  # 6: a new wall
    (found,) = slam.open_in_map
    assert found.keyframes == (3, 4, 5, 6, 7, 8)
    assert name_of(found.part, found.direction) == "along x" and np.isinf(found.sigma)


def test_the_size_of_what_is_open_is_that_of_the_normal_equations():
    """Each of two end walls, seen with 0.4 m from both keyframes, leaves 0.4 m times the root of two between them."""
    slam, badly, scene = PlaneSlam(), np.diag([0.16, 9e-6, 9e-6]), drive(0, count=2, turns=0.02)
    for frame, pose in zip(scene.keyframes, scene.world_T_body, strict=True):
        sights = [(plane, badly if abs(plane.normal[0]) > 0.5 else ROOM_COVARIANCE) for plane in room_planes()]
        seen = [sight(plane.transform(inverse(pose)), covariance) for plane, covariance in sights]
        slam.add_keyframe(Keyframe(frame.stamp_ns, seen, frame.motion, frame.world_T_body_guess))
    (found,) = slam.open_in_map
    assert name_of(found.part, found.direction) == "along x" and found.keyframes == (1,)
    assert found.sigma == pytest.approx(0.4, rel=0.01)
