"""Loop closure: verification of candidates, by searching one submap in another or by the constellation of walls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import chdtri

from slam.backend.estimator import Backend, pose_symbol
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.information import left_open
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import NO_FLOOR, Motion, planar_delta
from slam.geometry.frames import inverse, lift, planar_transform
from slam.loop_closure.candidates import DrivenPath, old_keyframes, radius_of
from slam.loop_closure.pairwise_consistency import Proposal
from slam.map.landmarks import Landmark, LandmarkMap
from slam.mapping.same_plane import hesse_of, landmark_keys
from slam.registration.correlative_search import PlaceView, SearchResult, search_place
from slam.registration.place_recognition import ConstellationMatch, Wall, match_constellations, match_near
from slam.registration.submaps import PlanarPose, view_of
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
    keyframes: Sequence[Keyframe]
    landmarks: LandmarkMap
    backend: Backend
    config: LoopConfig
    min_keyframes: int
    """Keyframes that must have seen a landmark before it takes part."""

    def landmarks_about(self, frame: int) -> list[Landmark]:
        """Confirmed landmarks seen within the window of travel around a keyframe."""
        first, last = self.path.window(frame, self.config.window_m)
        return [one for one in self._confirmed if one.was_seen_between(first, last)]

    @cached_property
    def _confirmed(self) -> list[Landmark]:
        return [landmark for landmark in self.landmarks if landmark.n_keyframes >= self.min_keyframes]

    def walls_about(self, frame: int) -> list[Wall]:
        """These as walls in the keyframe's frame, with their covariance relative to it."""
        pose_key, seen, walls = pose_symbol(frame), self.landmarks_about(frame), []
        if not seen:
            return []
        joint = self.backend.joint_covariance(sorted({pose_key}.union(*(landmark_keys(one) for one in seen))))
        body_T_world = inverse(self.backend.pose(pose_key))
        for one in seen:
            normal, d, jacobian, keys = hesse_of(one, self.backend, pose_key)
            covariance = jacobian @ joint.of(keys) @ jacobian.T
            body_T_plane = body_T_world @ self.landmarks.placed(one.id).world_T_plane
            walls.append(Wall.from_plane(normal, d, covariance, lift(one.extent.corners, body_T_plane)))
        return walls

    def view_about(self, frame: int) -> PlaceView | None:
        """What level lasers saw there, as a submap in its frame."""
        first, last = self.path.window(frame, self.config.window_m)
        members = range(first, last + 1)
        poses = [self.backend.pose(pose_symbol(member)) for member in members]
        return view_of([self.keyframes[member] for member in members], poses, self.path.pose(frame), self.config)

    def are_tied_by(self, shared: Sequence[Landmark]) -> bool:
        """Whether walls that two places see, in more than one direction, leave nothing open between them."""
        if len(shared) < self.config.min_walls:
            return False
        normals = np.array([self.landmarks.placed(one.id).normal for one in shared])
        return bool(np.abs(np.cross(normals[0], normals)).max() > _ACROSS)


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
    estimates = dict(zip(seen, PlanarPose.of_all(ends, around.backend), strict=True))
    for old in olds:
        there = around.landmarks_about(old)
        shared = [one for one in here if one in there]
        if old in estimates:
            estimate = estimates[old]
            if (estimate.reach_m <= config.tied_m and shared) or around.are_tied_by(shared):
                continue  # nothing is left to find
            view, other = view or around.view_about(now), around.view_about(old)
            if view is not None and other is not None:
                yield _decide_by_search(_searched(view, other, estimate, old, path, config), estimate, old, path)
        elif min(len(here), len(there)) >= config.min_walls > len(shared):
            match = match_constellations(around.walls_about(now), around.walls_about(old))
            yield _decide(match, old, around, here, there)


def _searched(
    view: PlaceView, other: PlaceView, estimate: PlanarPose, old: int, path: DrivenPath, config: LoopConfig
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


def _decide_by_search(found: SearchResult, estimate: PlanarPose, old: int, path: DrivenPath) -> LoopDecision:
    """The likeliest place, if it is likelier than all else together and inside the box that was searched."""
    now = len(path.lengths) - 1
    if not found.modes:
        return LoopDecision(now, old, "not seen")
    best = found.modes[0]
    far, turn = _offset(planar_transform(*estimate.delta), planar_transform(*best.pose))
    if found.place is None:
        rivals = len(found.modes) > 1 or found.is_at_edge
        return LoopDecision(now, old, "ambiguous" if rivals else "not seen", (), far, turn, evidence=best.evidence)
    pose = PlanarPose(best.pose, best.covariance)
    proposal = Proposal(now, old, pose, best.log_odds, float(path.lengths[-1]))
    return LoopDecision(now, old, "waiting", (), far, turn, evidence=best.evidence, proposal=proposal)


def proposed(proposal: Proposal, around: Surroundings) -> LoopDecision:
    """A closure that somebody else proposes, before it is accepted: known, where walls that both see bear it out."""
    now, old, pose = proposal.keyframe, proposal.old_keyframe, proposal.pose
    estimate = planar_delta(inverse(around.path.pose(old)) @ around.path.pose(now))
    far, turn = _offset(planar_transform(*estimate), planar_transform(*pose.delta))
    is_known = False
    if pose.misfit(estimate) <= chdtri(3, around.config.significance):
        here, there = (around.landmarks_about(frame) for frame in (now, old))
        is_known = around.are_tied_by([one for one in here if one in there])
    return LoopDecision(now, old, "known" if is_known else "waiting", (), far, turn, proposal=proposal)


def _offset(estimate: FloatArray, found: FloatArray) -> tuple[float, float]:
    """How far two motions (4, 4) lie from another, m, and how much they are turned, rad."""
    offset = inverse(estimate) @ found
    return float(np.linalg.norm(offset[:2, 3])), float(planar_delta(offset)[2])


def joined(decision: LoopDecision, proposal: Proposal, around: Surroundings) -> LoopDecision:
    """A proposed closure that is accepted: the walls that are one under its pose, and the motion beyond them.

    Where the walls do not bear the pose out, or there are none, the motion stands for itself: the walls may be one
    once the graph has taken it in.
    """
    now, old, pose = proposal.keyframe, proposal.old_keyframe, proposal.pose
    here, there = around.landmarks_about(now), around.landmarks_about(old)
    walls, significance = (around.walls_about(now), around.walls_about(old)), around.config.significance
    match = match_near(*walls, pose.delta, pose.covariance, significance=significance)
    motion: Motion | None = _motion(pose.delta, pose.covariance)
    pairs: tuple[tuple[int, int], ...] = ()
    if match is not None:
        beyond = None if match.by_walls is None else left_open(pose.covariance, match.by_walls)
        motion = None if beyond is None else _motion(pose.delta, beyond)
        pairs = _paired(match, here, there)
        decision = replace(decision, chi2=match.chi2, dof=match.n_dof)
    if not pairs and motion is not None:
        estimate = PlanarPose.of(pose_symbol(old), pose_symbol(now), around.backend)
        motion = motion if _is_news(motion, estimate, around.config) else None
    verdict: LoopVerdict = "closed" if pairs or motion is not None else "known"
    return replace(decision, verdict=verdict, pairs=pairs, motion=motion, proposal=proposal)


def without_walls(decision: LoopDecision) -> LoopDecision | None:
    """A loop that is closed by what the returns say alone; None: they do not propose it."""
    if decision.proposal is None:
        return None
    pose = decision.proposal.pose
    return replace(decision, verdict="closed", pairs=(), motion=_motion(pose.delta, pose.covariance))


def _motion(delta: FloatArray, covariance: FloatArray) -> Motion:
    """(x, y, theta) as a motion that says nothing of the floor."""
    return Motion(planar_transform(*delta), covariance, NO_FLOOR)


def _paired(
    match: ConstellationMatch, here: Sequence[Landmark], there: Sequence[Landmark]
) -> tuple[tuple[int, int], ...]:
    """Landmarks (older, younger) whose walls a match has as one."""
    found = [(here[i].id, there[j].id) for i, j in match.pairs.tolist() if here[i] is not there[j]]
    return tuple((min(pair), max(pair)) for pair in found)


def _is_news(motion: Motion, estimate: PlanarPose, config: LoopConfig) -> bool:
    """Whether a motion contradicts the estimate, or says it much better in a direction in which it is badly known."""
    error = planar_delta(motion.a_T_b) - estimate.delta
    spread = estimate.covariance + motion.covariance
    if float(error @ np.linalg.solve(spread, error)) > chdtri(3, config.significance):
        return True
    better = np.linalg.inv(np.linalg.inv(estimate.covariance) + np.linalg.inv(motion.covariance)).astype(np.float64)
    return replace(estimate, covariance=better).reach_m < 0.5 * estimate.reach_m > 0.5 * config.tied_m


def _decide(
    match: ConstellationMatch | None,
    old: int,
    around: Surroundings,
    here: Sequence[Landmark],
    there: Sequence[Landmark],
) -> LoopDecision:
    path, now = around.path, len(around.path.lengths) - 1
    if match is None:
        return LoopDecision(now, old, "not seen")
    distance, turn = _offset(inverse(path.pose(old)) @ path.poses[-1], match.b_T_a)
    pairs = _paired(match, here, there)
    drift = around.config.drift_share * float(path.lengths[now] - path.lengths[old])
    radius = radius_of(pose_symbol(now), around.backend) + drift
    verdict: LoopVerdict = "closed" if match.verdict == "closure" else match.verdict
    if verdict == "closed" and distance > radius:
        verdict = "far"
    if verdict == "closed" and not pairs:
        verdict = "too few"
    return LoopDecision(now, old, verdict, pairs, distance, turn, match.chi2, match.n_dof, match.evidence)
