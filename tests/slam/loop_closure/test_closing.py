"""What a closed loop says of the way along a corridor leaves the graph again when the loop turns out to be none."""

import numpy as np
import pytest

from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.loop_closure.closing import Closure
from slam.loop_closure.pairwise_consistency import Proposal
from slam.loop_closure.verification import LoopDecision
from slam.registration.submaps import PlanarPose
from tests.slam.registration.test_plane_registration import wall
from tests.slam.scenes import SIGMAS, drive, measured, run_of

COUNT, LENGTH_M = 40, 0.5
OUT_OF_PLANE = (1e2, 1e2, 1e2)


def corridor() -> list[Keyframe]:
    """Along two walls, a gap of 8 m, and two more: nothing but odometry tells how far."""
    rng, frames, covariance = np.random.default_rng(0), [], np.diag((1e-4, 1e-6, 1e-7))
    walls = [wall((x, y, 1.0), (0.0, -y, 0.0), 6.0, 2.0) for x in (3.0, 17.0) for y in (1.0, -1.0)]
    for index, x in enumerate(LENGTH_M * np.arange(COUNT)):
        pose = planar_transform(x, 0.0, 0.0)
        near = [plane for plane in walls if abs(plane.centre[0] - x) < 3.0 and index < COUNT - 1]
        seen = [PlaneObservation(measured(plane.transform(inverse(pose)), rng, SIGMAS)) for plane in near]
        step = np.array([LENGTH_M, 0.0, 0.0]) + np.sqrt(np.diag(covariance)) * rng.standard_normal(3)
        motion = Motion(planar_transform(*step), covariance, (1e-3, 1e-3, 1e-3)) if index else None
        frames.append(Keyframe(index * 10**9, seen, motion, pose if not index else None))
    return frames


def close(slam: PlaneSlam, old: int, pairs: list[tuple[int, int]], motion: Motion) -> None:
    """A loop closed at the last keyframe, as if it had been found there."""
    loop = LoopDecision(len(slam.keyframes) - 1, old, "closed", tuple(pairs), motion=motion)
    slam._closer.decisions.append(loop)
    assert slam.merges.close(pairs, 1.0)
    slam._closer.fix(Closure((loop,), tuple(pairs)))


def outline_areas(slam: PlaneSlam) -> list[float]:
    return [landmark.outline.area for landmark in slam.landmarks]


@pytest.mark.parametrize("batch", [False, True])
def test_along_a_bare_corridor_the_motion_goes_with_its_walls(batch: bool):
    frames = corridor()
    slam, untouched = run_of(frames[:-1]), run_of(frames[:-1])
    assert len(slam.landmarks) == 4
    sides = [slam.landmarks.placed(landmark).normal for landmark in range(4)]
    pairs = [(older, younger) for older in (0, 1) for younger in (2, 3) if sides[older] @ sides[younger] > 0.0]
    close(slam, 6, pairs, Motion(np.eye(4), np.diag((1e-4, 1e-4, 1e-6)), OUT_OF_PLANE))
    away = slam.trajectory.poses[-1] - untouched.trajectory.poses[-1]
    assert abs(away[0, 3]) > 10.0  # of two places that look the same the graph cannot tell
    if batch:
        slam.adopt_batch()
    run_of(frames[-1:], untouched)
    slam.merges.undo(slam.merges.history[0])
    run_of(frames[-1:], slam)
    [known] = slam._closer.closed
    assert known.undone == COUNT - 1
    assert slam.explain(COUNT - 1)[-1] == "keyframe 38 was found not to have come back to the place of keyframe 6"
    np.testing.assert_allclose(slam.trajectory.poses[:, 0, 3], untouched.trajectory.poses[:, 0, 3], atol=0.01)
    if not batch:  # after which factors are made anew
        slam.merges.undo(slam.merges.history[1])
        np.testing.assert_allclose(outline_areas(slam), outline_areas(untouched), rtol=0.05)
        assert slam.backend.graph.size() == untouched.backend.graph.size()


def test_a_motion_that_does_not_fit_is_taken_back_and_one_that_does_stays():
    scene = drive(3)
    for shift, stands in ((0.5, False), (0.0, True)):
        slam = run_of(scene.keyframes[:12])
        a_T_b = inverse(scene.world_T_body[2]) @ scene.world_T_body[11] @ planar_transform(shift, 0.0, 0.0)
        close(slam, 2, [], Motion(a_T_b, np.diag((1e-4, 1e-4, 1e-5)), OUT_OF_PLANE))
        run_of(scene.keyframes[12:], slam)
        assert (slam._closer.closed[0].undone is None) == stands
        np.testing.assert_allclose(slam.trajectory.poses, run_of(scene.keyframes).trajectory.poses, atol=0.01)


def test_a_place_beyond_doubt_is_tied_without_the_walls_that_the_graph_refuses():
    scene = drive(3)
    slam = run_of(scene.keyframes[:12])
    count, across = len(slam.landmarks), (0, 1)  # two planes of the room that are none
    pose = planar_delta(inverse(scene.world_T_body[2]) @ scene.world_T_body[11])
    proposal = Proposal(11, 2, PlanarPose(pose, np.diag((1e-4, 1e-4, 1e-5))), 20.0, 6.0)
    loop = LoopDecision(11, 2, "closed", (across,), proposal=proposal)
    slam._closer.decisions.append(loop)
    closure = slam._closer._close([loop], 1.0)
    assert closure is not None and closure.pairs == ()
    slam._closer.fix(closure)
    [known] = slam._closer.closed
    assert slam.loops[-1].verdict == "closed" and known.pairs == () and known.motion is not None
    assert len(slam.landmarks) == count and slam.merges.may_be_one(*across)
    run_of(scene.keyframes[12:], slam)
    assert known.undone is None


def test_what_the_graph_refuses_and_no_return_proposes_is_not_closed():
    slam, loop = run_of(drive(3).keyframes[:12]), LoopDecision(11, 2, "closed", ((0, 1),))
    slam._closer.decisions.append(loop)
    assert slam._closer._close([loop], 1.0) is None and slam.loops[-1].verdict == "refused"
    assert not slam.merges.may_be_one(0, 1)
