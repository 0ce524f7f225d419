"""A map levelled by its floor: the same map by other coordinates."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.errors import LogError
from slam.floorplan import floor_plan
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.runs.history import History
from slam.runs.stored_run import StoredRun, levelled
from spplanes import Plane
from tests.slam.floorplan.buildings import joint_of, planes_of

TILT = np.eye(4)
TILT[:3, :3] = Rotation.from_euler("xyz", (12.0, -7.0, 30.0), degrees=True).as_matrix()
TILT[:3, 3] = 5.0, 2.0, 1.0


def tilted(planes: list[Plane]) -> StoredRun:
    """A run whose first pose was not level."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(len(planes), 3, 3)) * 1e-3
    known = [
        Plane((TILT @ one.frame), root @ root.T + 1e-8 * np.eye(3), 50, one.outline)
        for one, root in zip(planes, roots, strict=True)
    ]
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(4, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(4, 3))
    way = Trajectory(np.arange(4) * 10**9, TILT @ poses)
    history = History(points=rng.normal(size=(5, 3)))
    return StoredRun(Path("run"), list(joint_of(known).planes), way, way, history, [])


def test_the_floor_is_level_and_all_else_as_it_was():
    run = tilted(planes_of())
    found = levelled(run)
    floor = max((one for one in found.planes if one.plane.normal[2] > 0.9), key=lambda one: one.seen.area)
    np.testing.assert_allclose(floor.plane.normal, [0.0, 0.0, 1.0], atol=1e-12)
    turn = found.moved_by
    assert turn is not None and not turn[:3, 3].any() and np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)
    assert turn[1, 0] == pytest.approx(0.0, abs=1e-12) and turn[0, 0] > 0.9  # x goes where it went
    before, after = run.trajectory.poses, found.trajectory.poses
    for ours, theirs in zip(found.planes, run.planes, strict=True):
        np.testing.assert_array_equal(ours.plane.covariance, theirs.plane.covariance)
        assert ours.seen is theirs.seen and ours.id == theirs.id
        gaps = [one.distance(poses[0, :3, 3]) for one, poses in ((ours.plane, after), (theirs.plane, before))]
        assert gaps[0] == pytest.approx(gaps[1], rel=1e-7)
    for i, j in combinations(range(3), 2):
        before, after = ([one.planes[k].plane for k in (i, j)] for one in (run, found))
        assert after[0].mahalanobis(after[1]) == pytest.approx(before[0].mahalanobis(before[1]), rel=1e-6)
    for one in ("trajectory", "odometry"):
        before, after = getattr(run, one).poses, getattr(found, one).poses
        np.testing.assert_allclose(inverse(after[0]) @ after[3], inverse(before[0]) @ before[3], atol=1e-12)
    np.testing.assert_allclose(found.history.points, run.history.points @ turn[:3, :3].T)


def test_the_map_then_has_the_coordinates_of_its_floor_plan():
    run = tilted(planes_of())
    plan = floor_plan(joint_of([one.plane for one in run.planes])).storeys[0]
    again = floor_plan(joint_of([one.plane for one in levelled(run).planes])).storeys[0]
    np.testing.assert_allclose(again.storey.plan, np.eye(3)[:, :2], atol=1e-12)
    for first, second in zip(plan.rooms, again.rooms, strict=True):
        np.testing.assert_allclose(plan.storey.in_plan(first.middle), second.middle[:2], atol=1e-9)


def test_what_is_level_stays_and_what_has_no_floor_is_refused():
    once = levelled(tilted(planes_of()))
    twice = levelled(once)
    np.testing.assert_allclose(twice.trajectory.poses, once.trajectory.poses, atol=1e-12)
    assert once.moved_by is not None and twice.moved_by is not None
    np.testing.assert_allclose(twice.moved_by, once.moved_by, atol=1e-12)
    with pytest.raises(LogError, match=r"run: expected a floor to level the map by, .* found none of its 2 planes"):
        levelled(tilted([plane for plane in planes_of() if abs(plane.normal[2]) < 0.1][:2]))
