"""Loop closure over a whole drive: every pair of stretches that may be one place, and the poses that they agree on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate

import gtsam
import numpy as np
from scipy.spatial import KDTree
from scipy.special import chdtri

from factors import odometry_factor_2d
from slam.backend.elimination import INDETERMINATE
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform, way_to
from slam.loop_closure.candidates import nearest_of_each
from slam.loop_closure.pairwise_consistency import Proposal
from slam.registration.correlative_search import PlaceView, search_place
from slam.registration.submaps import PlanarPose, view_of
from spplanes._check import FloatArray

#: Submaps that are kept to be searched in again.
_VIEWS = 16
#: Most pairs of stretches of a drive that are compared: of more, every second or third.
_MOST_PAIRS = 600
#: A robust solution is looked for in so many steps.
_STEPS = 100
#: Kernel of everything in it: a finding may be of another place, a step a slip.
_KERNEL = "cauchy"


@dataclass(frozen=True, eq=False)
class Agreement:
    """What a drive agrees on where all of it is held against all of it."""

    proposals: tuple[Proposal, ...]
    """Pairs of keyframes that stand near each other, in the order of the drive, of each two stretches one."""
    offsets_m: FloatArray
    """How far each of them is from where the estimate had it, m."""
    refused: int
    """Pairs that looked alike and do not agree with the others."""
    inferred: tuple[Proposal, ...] = ()
    """For every keyframe that passes an earlier one, where all of it together has it from there."""


def agreement(keyframes: Sequence[Keyframe], poses: FloatArray, config: LoopConfig) -> Agreement | None:
    """Which stretches of a drive are one place, all of it looked at once; None where it is not driven on a floor.

    Loops are closed on the way by what was known then, and where one was missed or was none, all that follows bends to
    the map that is there. Here the map is not asked: every pair of stretches that the estimate has near each other is
    searched for its relative pose, as far around as the drive may have drifted. The graph of these findings and of all
    steps as wheels and successive scans measured them is solved under a robust kernel, from the estimate and from dead
    reckoning, whichever costs less. What fits the solution is what the drive agrees on.

    Args:
        keyframes: what was measured; those with `returns` take part.
        poses: the estimate, world_T_body of each, shape (N, 4, 4).
        config: the rules of loop closure; `significance` is the probability that a right finding is left out.
    """
    steps = [keyframe.motion for keyframe in keyframes[1:]]
    if not steps or not all(step is not None and step.is_planar for step in steps):
        return None
    way, motions = way_to(poses), [step.scan_matched or step for step in steps if step is not None]
    reckoned = np.array(list(accumulate((motion.a_T_b for motion in motions), np.matmul, initial=poses[0])))
    found = list(_search(keyframes, poses, reckoned, way, config))
    graph, values = _solved(motions, found, poses, reckoned)
    solved = np.array([planar_transform(*_delta(values.atPose2(index))) for index in range(len(poses))])
    limit = float(chdtri(3, config.significance))
    fitting = [one for one in found if one.pose.misfit(one.delta_by(solved)) <= limit]
    chosen = _one_of_each(fitting, way, config.window_m)
    offsets = np.array([one.offset_m(poses) for one in chosen])
    inferred = _inferred(graph, values, solved, way, config) if chosen else ()
    return Agreement(tuple(chosen), offsets, len(found) - len(fitting), inferred)


def _search(
    keyframes: Sequence[Keyframe], poses: FloatArray, reckoned: FloatArray, way: FloatArray, config: LoopConfig
) -> Iterator[Proposal]:
    """The likeliest relative pose of every pair of stretches, where it is likelier than all else together.

    A stretch is as `reckoned`, step by step: where the estimate bends to a false loop, it is no building.
    """

    @lru_cache(_VIEWS)
    def view(frame: int) -> PlaceView | None:
        first, last = np.searchsorted(way, (way[frame] - config.window_m, way[frame] + config.window_m)).tolist()
        return view_of(keyframes[first:last], list(reckoned[first:last]), reckoned[frame], config)

    for old, new in _pairs(keyframes, poses, way, config):
        here, there = view(new), view(old)
        if here is None or there is None:
            continue
        drift = min(config.drift_share * (way[new] - way[old]), 0.5 * config.window_m)
        reach = drift * np.array((1.0, 1.0, 2.0 / config.window_m))
        guess, covariance = planar_delta(inverse(poses[old]) @ poses[new]), np.diag((reach / BOUND_SIGMAS) ** 2)
        found = search_place(here, there, guess, covariance, reach, looks=config.looks_per_place)
        if (best := found.place) is not None:
            yield Proposal(new, old, PlanarPose(best.pose, best.covariance), best.log_odds, float(way[new]))


def _pairs(
    keyframes: Sequence[Keyframe], poses: FloatArray, way: FloatArray, config: LoopConfig
) -> list[tuple[int, int]]:
    """Keyframes (old, new), two in a window of travel, about which the estimate has the drive twice in one place.

    Of each stretch that lies near, the nearest. Loops shorter than three windows are left to association.
    """
    nodes: list[int] = []
    for frame, keyframe in enumerate(keyframes):
        is_due = not nodes or way[frame] - way[nodes[-1]] >= 0.5 * config.window_m
        if is_due and keyframe.returns is not None and len(keyframe.returns):
            nodes.append(frame)
    places, lengths, pairs = poses[nodes, :2, 3], way[nodes], []
    tree = KDTree(places)
    for row, new in enumerate(nodes):
        near = np.array(tree.query_ball_point(places[row], config.window_m), dtype=np.int64)
        near = near[lengths[row] - lengths[near] > 3.0 * config.window_m]
        away = np.linalg.norm(places[near] - places[row], axis=1)
        stretch = np.floor(lengths[near] / config.window_m)
        pairs += [(nodes[one], new) for one in nearest_of_each(near, away, stretch).tolist()]
    return pairs[:: max(1, -(-len(pairs) // _MOST_PAIRS))]


def _solved(
    steps: Sequence[Motion], found: Sequence[Proposal], *starts: FloatArray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph of steps and findings, and the Pose2 of every keyframe by it, from the best of some poses to start."""
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(gtsam.NonlinearEqualityPose2(0, gtsam.Pose2(*planar_delta(starts[0][0]))))
    for index, step in enumerate(steps):
        delta = planar_delta(step.a_T_b)
        graph.push_back(odometry_factor_2d(index, index + 1, delta, step.covariance, robust=_KERNEL))
    for one in found:
        ends = one.old_keyframe, one.keyframe
        graph.push_back(odometry_factor_2d(*ends, one.pose.delta, one.pose.covariance, robust=_KERNEL))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_STEPS)
    found_from = [gtsam.LevenbergMarquardtOptimizer(graph, _poses2(one), parameters).optimize() for one in starts]
    return graph, min(found_from, key=graph.error)


def _poses2(poses: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    for index, pose in enumerate(poses):
        values.insert(index, gtsam.Pose2(*planar_delta(pose)))
    return values


def _inferred(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, places: FloatArray, way: FloatArray, config: LoopConfig
) -> tuple[Proposal, ...]:
    """Where each keyframe is from the nearest of those more than three windows before: a laser sees far.

    Nothing, where the kernel lets go of so much that the drive falls apart.
    """
    try:
        return tuple(_from_earlier(gtsam.Marginals(graph, values), values, places, way, config))
    except RuntimeError as error:
        if INDETERMINATE not in str(error):
            raise
        return ()


def _from_earlier(
    marginals: gtsam.Marginals, values: gtsam.Values, places: FloatArray, way: FloatArray, config: LoopConfig
) -> Iterator[Proposal]:
    """See `_inferred`."""
    for new, length in enumerate(way.tolist()):
        n_before = int(np.searchsorted(way, length - 3.0 * config.window_m))
        if not n_before:
            continue
        nearest = int(np.argmin(np.linalg.norm(places[:n_before, :2, 3] - places[new, :2, 3], axis=1)))
        by_old, by_new = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
        there = values.atPose2(nearest).between(values.atPose2(new), by_old, by_new)
        turn = np.eye(3)
        turn[:2, :2] = there.rotation().matrix()
        jacobian = turn @ np.hstack((by_old, by_new))
        joint = marginals.jointMarginalCovariance([nearest, new]).fullMatrix()
        yield Proposal(new, nearest, PlanarPose(_delta(there), jacobian @ joint @ jacobian.T), np.inf, length)


def _delta(pose: gtsam.Pose2) -> FloatArray:
    return np.array((pose.x(), pose.y(), pose.theta()))


def _one_of_each(found: Sequence[Proposal], way: FloatArray, window_m: float) -> list[Proposal]:
    """Of findings about the same two stretches the likeliest: the others saw the same."""
    chosen: dict[tuple[int, ...], Proposal] = {}
    for one in sorted(found, key=lambda one: (-one.log_odds, one.keyframe, one.old_keyframe)):
        stretches = np.floor(way[[one.old_keyframe, one.keyframe]] / window_m).astype(int)
        chosen.setdefault(tuple(stretches.tolist()), one)
    return sorted(chosen.values(), key=lambda one: (one.keyframe, one.old_keyframe))
