"""Closing loops: what is seen now against what was seen from an old place, by the constellation of the walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam.backend.estimator import Backend, pose_symbol
from slam.config import LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import Raster
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.loop_closure.candidates import DrivenPath, old_keyframes, radius_of
from slam.loop_closure.local_map import surroundings, view_about, walls_from
from slam.map.landmarks import Landmark, LandmarkMap
from slam.registration.place_recognition import ConstellationMatch, Wall, match_constellations, match_near
from slam.registration.scan_matching import Relocation
from slam.registration.submaps import RelativePose, compare_views, left_open

LoopVerdict = Literal["closed", "refused", "not seen", "ambiguous", "unobservable", "far", "too few"]

#: Sine of the angle from which on two walls fix a place between them.
_ACROSS = 0.26
#: Of height (m), roll and pitch (rad) the views of level lasers say nothing.
_OUT_OF_PLANE = (1e2, 1e2, 1e2)


@dataclass(frozen=True)
class LoopDecision:
    """What became of the comparison of a keyframe's surroundings with those of an old one, and why."""

    keyframe: int
    """The keyframe."""
    old_keyframe: int
    """The keyframe it was compared with."""
    verdict: LoopVerdict
    """closed: one place, its walls are joined; refused: it looks like one, but the graph as a whole is against it; not
    seen: no match; ambiguous, unobservable: as the constellations say;
    far: the match contradicts the estimate beyond the search radius; too few: no pair of walls was left to join."""
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


def find_loop(
    path: DrivenPath,
    keyframes: Sequence[Keyframe],
    landmarks: LandmarkMap,
    backend: Backend,
    config: LoopConfig,
    min_keyframes: int,
) -> list[LoopDecision]:
    """Compare the surroundings of the last keyframe with those of old keyframes near it until one is found to be them.

    Surroundings are the landmarks seen within `config.window_m` of travel, as walls in the frame of the keyframe with
    the covariance that they have relative to it, and what level lasers saw on the way. Where there are such lasers,
    the pose is found by all their returns and all free space, and walls are the same that are so under it; else it is
    found by the constellation of the walls. How far the whole has drifted only bounds where it is looked for.

    Returns:
        One decision for every old keyframe compared with; only the last of them may be "closed".
    """
    now = len(path.lengths) - 1
    here = surroundings(now, path, landmarks, config, min_keyframes)
    decisions: list[LoopDecision] = []
    has_view = keyframes[now].returns is not None
    if len(here) < (1 if has_view else config.min_walls):
        return decisions
    view: Raster | None = None
    walls: list[Wall] = []
    for old in old_keyframes(path, backend, config):
        there = surroundings(old, path, landmarks, config, min_keyframes)
        shared = [one for one in here if one in there]
        if has_view and there and keyframes[old].returns is not None:
            if _fix_a_place(shared, landmarks, config):
                continue
            estimate = RelativePose.of(pose_symbol(old), pose_symbol(now), backend)
            if estimate.reach_m <= config.tied_m and shared:
                continue
            view = view or view_about(now, path, keyframes, backend, config)
            other = view_about(old, path, keyframes, backend, config)
            if view is None or other is None:
                continue
            way = float(path.lengths[now] - path.lengths[old])
            found = compare_views(view, other, estimate, config.drift_share * way, way)
            walls = walls or walls_from(pose_symbol(now), here, landmarks, backend)
            others = walls_from(pose_symbol(old), there, landmarks, backend)
            decisions.append(
                _decide_by_view(found, estimate, old, path, (walls, here), (others, there), backend, config)
            )
        elif min(len(here), len(there)) >= config.min_walls > len(shared):
            walls = walls or walls_from(pose_symbol(now), here, landmarks, backend)
            match = match_constellations(walls, walls_from(pose_symbol(old), there, landmarks, backend))
            decisions.append(_decide(match, old, path, here, there, backend, config))
        if decisions and decisions[-1].verdict == "closed":
            break
    return decisions


def _fix_a_place(shared: Sequence[Landmark], landmarks: LandmarkMap, config: LoopConfig) -> bool:
    """Whether two places see so many walls in common, in more than one direction, that nothing is left to find."""
    if len(shared) < config.min_walls:
        return False
    normals = np.array([landmarks.placed(one.id).normal for one in shared])
    return bool(np.abs(np.cross(normals[0], normals)).max() > _ACROSS)


def _decide_by_view(
    found: Relocation,
    estimate: RelativePose,
    old: int,
    path: DrivenPath,
    here: tuple[Sequence[Wall], Sequence[Landmark]],
    there: tuple[Sequence[Wall], Sequence[Landmark]],
    backend: Backend,
    config: LoopConfig,
) -> LoopDecision:
    """Joined is what is one wall under the pose found by the views, if that is beyond doubt."""
    now = len(path.lengths) - 1
    if found.share < 1.0 - config.significance:
        verdict: LoopVerdict = "not seen" if found.evidence < 0.0 else "ambiguous"
        return LoopDecision(now, old, verdict, evidence=found.evidence)
    match = match_near(here[0], there[0], found.pose, found.covariance, significance=config.significance)
    if match is None:
        return LoopDecision(now, old, "too few", evidence=found.evidence)
    decision = replace(_decide(match, old, path, here[1], there[1], backend, config), evidence=found.evidence)
    if decision.verdict not in ("closed", "too few"):
        return decision
    motion = _motion_beyond(found, match)
    if motion is None:
        return decision
    if decision.verdict == "closed" or _is_news(motion, estimate, config):
        return replace(decision, verdict="closed", motion=motion)
    return decision


def _is_news(motion: Motion, estimate: RelativePose, config: LoopConfig) -> bool:
    """Whether a motion contradicts the estimate, or says it much better in a direction in which it is badly known."""
    error = planar_delta(motion.a_T_b) - estimate.delta
    spread = estimate.covariance + motion.covariance
    if float(error @ np.linalg.solve(spread, error)) > chi2_distribution.isf(config.significance, 3):
        return True
    better = np.linalg.inv(np.linalg.inv(estimate.covariance) + np.linalg.inv(motion.covariance))
    return replace(estimate, covariance=better).reach_m < 0.5 * estimate.reach_m > 0.5 * config.tied_m


def _motion_beyond(found: Relocation, match: ConstellationMatch) -> Motion | None:
    """What the views say of the motion beyond the walls that are joined."""
    covariance = None if match.by_walls is None else left_open(found.covariance, match.by_walls)
    if covariance is None:
        return None
    return Motion(planar_transform(*found.pose), covariance, _OUT_OF_PLANE)


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


def disjoint(pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those pairs whose landmarks are in no pair before them."""
    used: set[int] = set()
    chosen = []
    for pair in pairs:
        if used.isdisjoint(pair):
            chosen.append(pair)
            used.update(pair)
    return chosen
