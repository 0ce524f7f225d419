"""Loop closure: verification of candidates, by searching one submap in another or by the constellation of walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri

from slam.backend.estimator import Backend, JointCovariance, pose_symbol
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.information import left_open
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import Raster
from slam.frontend.odometry import NO_FLOOR, Motion, planar_delta
from slam.geometry.frames import inverse, lift, planar_transform
from slam.loop_closure.candidates import DrivenPath, old_keyframes, radius_of
from slam.loop_closure.pairwise_consistency import PlanarPose, Proposal
from slam.map.landmarks import Landmark, LandmarkMap
from slam.mapping.same_plane import hesse_from, landmark_keys
from slam.registration.correlative_search import PlaceView, SearchResult, search_place
from slam.registration.place_recognition import ConstellationMatch, Wall, match_constellations, match_near
from slam.registration.submaps import RelativePose, view_of
from spplanes._check import FloatArray

LoopVerdict = Literal[
    "closed", "waiting", "refused", "known", "not seen", "ambiguous", "unobservable", "far", "too few"
]

#: Sine of the angle from which on two walls fix a place between them.
_ACROSS = 0.26


@dataclass(frozen=True)
class LoopDecision:
    """What became of the comparison of a keyframe's surroundings with those of an old one, and why."""

    keyframe: int
    """The keyframe."""
    old_keyframe: int
    """The keyframe it was compared with."""
    verdict: LoopVerdict
    """closed: one place, its walls are joined; waiting: likely one, until others agree; refused: it looks like one, but
    the graph as a whole is against it; known: one, which the map has so already; not seen: no match; ambiguous:
    other places are as likely; unobservable: as the constellations say; far: the match contradicts the estimate beyond
    the search radius; too few: no pair of walls was left to join."""
    pairs: tuple[tuple[int, int], ...] = ()
    """Landmarks found to be one, as (older, younger)."""
    offset_m: float = float("nan")
    """How far the matched pose of the keyframe lies from the estimate, m."""
    offset_rad: float = float("nan")
    """The same of its heading, rad."""
    chi2: float = float("nan")
    """Chi2 of the matched walls at the matched motion."""
    dof: int = 0
    """Its degrees of freedom."""
    evidence: float = float("nan")
    """Log of how much better the walls, or all returns, agree than by chance."""
    motion: Motion | None = None
    """From the old keyframe to the keyframe, what the returns say of it beyond the walls."""
    proposal: Proposal | None = None
    """What the search of the submaps proposes."""


@dataclass(frozen=True)
class Surroundings:
    """What loops are verified with."""

    path: DrivenPath
    """The way so far."""
    keyframes: Sequence[Keyframe]
    """What was measured."""
    landmarks: LandmarkMap
    """The map."""
    backend: Backend
    """The graph."""
    config: LoopConfig
    """The settings."""
    min_keyframes: int
    """Keyframes that must have seen a landmark before it takes part."""

    def landmarks_about(self, frame: int) -> list[Landmark]:
        """Landmarks seen within the window of travel around a keyframe."""
        return surroundings(frame, self.path, self.landmarks, self.config, self.min_keyframes)

    def view_about(self, frame: int) -> PlaceView | None:
        """What level lasers saw there, as a submap in its frame."""
        view = view_about(frame, self.path, self.keyframes, self.backend, self.config)
        return None if view is None else PlaceView(view)


def compare_with_old(around: Surroundings) -> Iterator[LoopDecision]:
    """Compare the surroundings of the last keyframe with those of old keyframes near it, one decision for each.

    Surroundings are what level lasers saw within `config.window_m` of travel, as a submap, and the landmarks seen
    there, as walls in the frame of the keyframe with the covariance that they have relative to it. Where there are such
    lasers, the submap is searched in the old one, and what is likeliest is proposed; else the pose is found by the
    constellation of the walls. How far the whole has drifted only bounds where it is looked for.
    """
    path, config = around.path, around.config
    now = len(path.lengths) - 1
    here = around.landmarks_about(now)
    has_view = around.keyframes[now].returns is not None
    if len(here) < (1 if has_view else config.min_walls):
        return
    view: PlaceView | None = None
    olds = old_keyframes(path, around.backend, config)
    seen = [old for old in olds if has_view and around.keyframes[old].returns is not None]
    ends = [(pose_symbol(old), pose_symbol(now)) for old in seen]
    estimates = dict(zip(seen, RelativePose.of_all(ends, around.backend), strict=True))
    for old in olds:
        there = around.landmarks_about(old)
        shared = [one for one in here if one in there]
        if old in estimates:
            estimate = estimates[old]
            if is_tied(shared, estimate, around.landmarks, config):
                continue
            view, other = view or around.view_about(now), around.view_about(old)
            if view is not None and other is not None:
                yield _decide_by_search(_searched(view, other, estimate, old, path, config), estimate, old, path)
        elif min(len(here), len(there)) >= config.min_walls > len(shared):
            match = match_constellations(*(_walls(around, frame) for frame in (now, old)))
            yield _decide(match, old, path, here, there, around.backend, config)


def is_tied(shared: Sequence[Landmark], estimate: RelativePose, landmarks: LandmarkMap, config: LoopConfig) -> bool:
    """Whether two places see so much in common that nothing is left to find: walls in more than one direction."""
    return bool(estimate.reach_m <= config.tied_m and shared) or ties(shared, landmarks, config)


def ties(shared: Sequence[Landmark], landmarks: LandmarkMap, config: LoopConfig) -> bool:
    """Whether walls that two places see, in more than one direction, leave nothing open between them."""
    if len(shared) < config.min_walls:
        return False
    normals = np.array([landmarks.placed(one.id).normal for one in shared])
    return bool(np.abs(np.cross(normals[0], normals)).max() > _ACROSS)


def _searched(
    view: PlaceView, other: PlaceView, estimate: RelativePose, old: int, path: DrivenPath, config: LoopConfig
) -> SearchResult:
    """Where the submap of the newest keyframe lies in that of an old one."""
    way = float(path.lengths[-1] - path.lengths[old])
    drift = min(config.drift_share * way, _MISTRUST * estimate.reach_m)
    beyond = np.array((drift, drift, 2.0 * drift / max(way, drift))) / BOUND_SIGMAS
    covariance = estimate.covariance + np.diag(beyond**2)
    reach = np.minimum(BOUND_SIGMAS * np.sqrt(np.diag(covariance)), (np.inf, np.inf, np.pi))
    return search_place(view, other, estimate.delta, covariance, reach, looks=config.looks_per_place)


#: The way may have drifted so many times further than the estimate says.
_MISTRUST = 2.0


def _decide_by_search(found: SearchResult, estimate: RelativePose, old: int, path: DrivenPath) -> LoopDecision:
    """The likeliest place, if it is likelier than all else together and inside the box that was searched."""
    now = len(path.lengths) - 1
    if not found.modes:
        return LoopDecision(now, old, "not seen")
    best = found.modes[0]
    far, turn = _offset(estimate.delta, best.pose)
    if best.log_odds <= 0.0 or found.is_at_edge:
        rivals = len(found.modes) > 1 or found.is_at_edge
        return LoopDecision(now, old, "ambiguous" if rivals else "not seen", (), far, turn, evidence=best.evidence)
    pose = PlanarPose(best.pose, best.covariance)
    proposal = Proposal(now, old, pose, best.log_odds, float(path.lengths[-1]))
    return LoopDecision(now, old, "waiting", (), far, turn, evidence=best.evidence, proposal=proposal)


def proposed(proposal: Proposal, around: Surroundings) -> LoopDecision:
    """A closure that somebody else proposes, before it is accepted: known, where walls that both see bear it out."""
    now, old, pose = proposal.keyframe, proposal.old_keyframe, proposal.pose
    estimate = planar_delta(inverse(around.path.pose(old)) @ around.path.pose(now))
    far, turn = _offset(estimate, pose.delta)
    is_known = False
    if pose.misfit(estimate) <= chdtri(3, around.config.significance):
        here, there = (around.landmarks_about(frame) for frame in (now, old))
        is_known = ties([one for one in here if one in there], around.landmarks, around.config)
    return LoopDecision(now, old, "known" if is_known else "waiting", (), far, turn, proposal=proposal)


def _offset(estimate: FloatArray, found: FloatArray) -> tuple[float, float]:
    """How far two motions (x, y, theta) lie from another, m, and how much they are turned, rad."""
    offset = inverse(planar_transform(*estimate)) @ planar_transform(*found)
    return float(np.linalg.norm(offset[:2, 3])), float(planar_delta(offset)[2])


def joined(decision: LoopDecision, proposal: Proposal, around: Surroundings) -> LoopDecision:
    """A proposed closure that is accepted: the walls that are one under its pose, and the motion beyond them.

    Where the walls do not bear the pose out, or there are none, the motion stands for itself: the walls may be one
    once the graph has taken it in.
    """
    now, old, pose = proposal.keyframe, proposal.old_keyframe, proposal.pose
    here, there = around.landmarks_about(now), around.landmarks_about(old)
    match = match_near(
        _walls(around, now), _walls(around, old), pose.delta, pose.covariance, significance=around.config.significance
    )
    motion: Motion | None = Motion(planar_transform(*pose.delta), pose.covariance, NO_FLOOR)
    pairs: tuple[tuple[int, int], ...] = ()
    if match is not None:
        motion = _motion_beyond(pose, match)
        found = [(here[i].id, there[j].id) for i, j in match.pairs.tolist() if here[i] is not there[j]]
        pairs = tuple((min(pair), max(pair)) for pair in found)
        decision = replace(decision, chi2=match.chi2, dof=match.n_dof)
    if not pairs and motion is not None:
        estimate = RelativePose.of(pose_symbol(old), pose_symbol(now), around.backend)
        motion = motion if _is_news(motion, estimate, around.config) else None
    verdict: LoopVerdict = "closed" if pairs or motion is not None else "known"
    return replace(decision, verdict=verdict, pairs=pairs, motion=motion, proposal=proposal)


def without_walls(decision: LoopDecision) -> LoopDecision | None:
    """A loop that is closed by what the returns say alone; None: they do not propose it."""
    if decision.proposal is None:
        return None
    pose = decision.proposal.pose
    motion = Motion(planar_transform(*pose.delta), pose.covariance, NO_FLOOR)
    return replace(decision, verdict="closed", pairs=(), motion=motion)


def _walls(around: Surroundings, frame: int) -> list:
    """The landmarks about a keyframe as walls in its frame; none where there are none."""
    seen = around.landmarks_about(frame)
    return walls_from(pose_symbol(frame), seen, around.landmarks, around.backend) if seen else []


def _is_news(motion: Motion, estimate: RelativePose, config: LoopConfig) -> bool:
    """Whether a motion contradicts the estimate, or says it much better in a direction in which it is badly known."""
    error = planar_delta(motion.a_T_b) - estimate.delta
    spread = estimate.covariance + motion.covariance
    if float(error @ np.linalg.solve(spread, error)) > chdtri(3, config.significance):
        return True
    better = np.linalg.inv(np.linalg.inv(estimate.covariance) + np.linalg.inv(motion.covariance)).astype(np.float64)
    return replace(estimate, covariance=better).reach_m < 0.5 * estimate.reach_m > 0.5 * config.tied_m


def _motion_beyond(found: PlanarPose, match: ConstellationMatch) -> Motion | None:
    """What the submaps say of the motion beyond the walls that are joined."""
    covariance = None if match.by_walls is None else left_open(found.covariance, match.by_walls)
    if covariance is None:
        return None
    return Motion(planar_transform(*found.delta), covariance, NO_FLOOR)


def _decide(
    match: ConstellationMatch | None,
    old: int,
    path: DrivenPath,
    here: Sequence[Landmark],
    there: Sequence[Landmark],
    backend: Backend,
    config: LoopConfig,
) -> LoopDecision:
    now = len(path.lengths) - 1
    if match is None:
        return LoopDecision(now, old, "not seen")
    offset = inverse(inverse(path.pose(old)) @ path.poses[-1]) @ match.b_T_a
    distance = float(np.linalg.norm(offset[:2, 3]))
    turn = float(np.arctan2(offset[1, 0], offset[0, 0]))
    found = [(here[i].id, there[j].id) for i, j in match.pairs.tolist() if here[i] is not there[j]]
    pairs = tuple((min(pair), max(pair)) for pair in found)
    radius = radius_of(pose_symbol(now), backend) + config.drift_share * float(path.lengths[now] - path.lengths[old])
    verdict: LoopVerdict = "closed" if match.verdict == "closure" else match.verdict
    if verdict == "closed" and distance > radius:
        verdict = "far"
    if verdict == "closed" and not pairs:
        verdict = "too few"
    return LoopDecision(now, old, verdict, pairs, distance, turn, match.chi2, match.n_dof, match.evidence)


def surroundings(
    index: int, path: DrivenPath, landmarks: LandmarkMap, config: LoopConfig, min_keyframes: int
) -> list[Landmark]:
    """Confirmed landmarks seen within the window of travel around a keyframe."""
    first, last = path.window(index, config.window_m)
    return [
        landmark
        for landmark in landmarks
        if landmark.n_keyframes >= min_keyframes and landmark.was_seen_between(first, last)
    ]


def view_about(
    frame: int, path: DrivenPath, keyframes: Sequence[Keyframe], backend: Backend, config: LoopConfig
) -> Raster | None:
    """What level lasers saw within the window of travel around a keyframe, in its frame."""
    first, last = path.window(frame, config.window_m)
    members = list(range(first, last + 1))
    poses = [backend.pose(pose_symbol(one)) for one in members]
    return view_of([keyframes[one] for one in members], poses, path.pose(frame), config)


def walls_from(pose_key: int, seen: Sequence[Landmark], landmarks: LandmarkMap, backend: Backend) -> list[Wall]:
    """The landmarks as walls in the frame of a pose, with their covariance relative to it."""
    keys = {pose_key}.union(*(landmark_keys(landmark) for landmark in seen))
    joint = backend.joint_covariance(sorted(keys))
    body_T_world = inverse(backend.pose(pose_key))
    return [_wall_from(pose_key, one, body_T_world, landmarks, backend, joint) for one in seen]


def _wall_from(
    pose_key: int,
    landmark: Landmark,
    body_T_world: FloatArray,
    landmarks: LandmarkMap,
    backend: Backend,
    joint: JointCovariance,
) -> Wall:
    normal, d, jacobian, keys = hesse_from(landmark, pose_key, backend)
    covariance = jacobian @ joint.of(keys) @ jacobian.T
    body_T_plane = body_T_world @ landmarks.placed(landmark.id).world_T_plane
    return Wall.from_plane(normal, d, covariance, lift(landmark.extent.corners, body_T_plane))
