"""Closing loops: what is seen now against what was seen from an old place, by the constellation of the walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from slam.backend import Backend, JointCovariance
from slam.config import LoopConfig
from slam.constellation import ConstellationMatch, Wall, match_constellations
from slam.frames import inverse, lift
from slam.landmarks import Landmark, LandmarkMap
from slam.twins import hesse_from, landmark_keys
from spplanes._check import FloatArray

LoopVerdict = Literal["closed", "not seen", "ambiguous", "unobservable", "far", "too few"]

#: Bounds drawn from a standard deviation are taken at this many of them.
_SIGMAS = 3.0
#: Walls that lean more than this from the body's vertical take no part: sine of the lean.
_MAX_LEAN = 0.2


@dataclass(frozen=True)
class LoopDecision:
    """What became of the comparison of a keyframe's surroundings with those of an old one, and why."""

    keyframe: int
    """The keyframe."""
    old_keyframe: int
    """The keyframe it was compared with."""
    verdict: LoopVerdict
    """closed: one place, its walls are joined; not seen: no match; ambiguous, unobservable: as the constellations say;
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
    """Log of how much better the walls agree than by chance."""


@dataclass(frozen=True, eq=False)
class Path:
    """Where the keyframes are by the current estimate."""

    keys: Sequence[int]
    """Pose keys, in time order."""
    poses: FloatArray
    """world_T_body, shape (N, 4, 4)."""
    lengths: FloatArray
    """Length of the way to each, m, shape (N,)."""

    @classmethod
    def of(cls, keys: Sequence[int], backend: Backend) -> Path:
        """From the backend's estimate."""
        poses = np.array([backend.pose(key) for key in keys])
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        return cls(keys, poses, np.concatenate(([0.0], np.cumsum(steps))))


def find_loop(
    path: Path, landmarks: LandmarkMap, backend: Backend, config: LoopConfig, min_keyframes: int
) -> list[LoopDecision]:
    """Compare the surroundings of the last keyframe with those of old keyframes near it until one is found to be them.

    Surroundings are the landmarks seen within `config.window_m` of travel, as walls in the frame of the keyframe with
    the covariance that they have relative to it. How far the whole has drifted does not enter the match; it only
    bounds where it is looked for.

    Returns:
        One decision for every old keyframe compared with; only the last of them may be "closed".
    """
    now = len(path.keys) - 1
    here = _surroundings(now, path, landmarks, config, min_keyframes)
    decisions: list[LoopDecision] = []
    if len(here) < config.min_walls:
        return decisions
    walls = _walls_from(path.keys[now], here, landmarks, backend)
    known = {landmark.id for landmark in here}
    for old in _old_keyframes(path, backend, config):
        there = _surroundings(old, path, landmarks, config, min_keyframes)
        shared = sum(landmark.id in known for landmark in there)
        if len(there) < config.min_walls or shared >= config.min_walls:
            continue
        match = match_constellations(walls, _walls_from(path.keys[old], there, landmarks, backend))
        decisions.append(_decide(match, old, path, here, there, backend, config))
        if decisions[-1].verdict == "closed":
            break
    return decisions


def _surroundings(
    index: int, path: Path, landmarks: LandmarkMap, config: LoopConfig, min_keyframes: int
) -> list[Landmark]:
    """Confirmed landmarks seen within the window of travel around a keyframe."""
    inside = np.flatnonzero(np.abs(path.lengths - path.lengths[index]) <= config.window_m)
    first, last = int(inside[0]), int(inside[-1])
    return [
        landmark
        for landmark in landmarks
        if landmark.n_keyframes >= min_keyframes
        and any(first <= sighting.keyframe <= last for sighting in landmark.sightings)
    ]


def _old_keyframes(path: Path, backend: Backend, config: LoopConfig) -> list[int]:
    """Keyframes of long ago within the search radius, nearest first, one in each stretch of the way."""
    now = len(path.keys) - 1
    since = path.lengths[now] - path.lengths
    distances = np.linalg.norm(path.poses[:, :3, 3] - path.poses[now, :3, 3], axis=1)
    radius = _radius(path.keys[now], backend) + config.drift_share * since + config.window_m
    wanted = np.flatnonzero((since > 3.0 * config.window_m) & (distances <= radius))
    chosen: list[int] = []
    for index in wanted[np.argsort(distances[wanted], kind="stable")].tolist():
        if all(abs(path.lengths[index] - path.lengths[other]) > config.window_m for other in chosen):
            chosen.append(index)
    return chosen[: config.max_candidates]


def _radius(pose_key: int, backend: Backend) -> float:
    covariance = backend.covariance(pose_key)[3:, 3:]
    return _SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _decide(
    match: ConstellationMatch | None,
    old: int,
    path: Path,
    here: Sequence[Landmark],
    there: Sequence[Landmark],
    backend: Backend,
    config: LoopConfig,
) -> LoopDecision:
    now = len(path.keys) - 1
    if match is None:
        return LoopDecision(now, old, "not seen")
    offset = inverse(inverse(path.poses[old]) @ path.poses[now]) @ match.b_T_a
    distance = float(np.linalg.norm(offset[:2, 3]))
    turn = float(np.arctan2(offset[1, 0], offset[0, 0]))
    found = [(here[i].id, there[j].id) for i, j in match.pairs.tolist() if here[i] is not there[j]]
    pairs = tuple((min(pair), max(pair)) for pair in found)
    radius = _radius(path.keys[now], backend) + config.drift_share * float(path.lengths[now] - path.lengths[old])
    verdict: LoopVerdict = "closed" if match.verdict == "closure" else match.verdict
    if verdict == "closed" and distance > radius:
        verdict = "far"
    if verdict == "closed" and not pairs:
        verdict = "too few"
    return LoopDecision(now, old, verdict, pairs, distance, turn, match.chi2, match.n_dof, match.evidence)


def _walls_from(pose_key: int, seen: Sequence[Landmark], landmarks: LandmarkMap, backend: Backend) -> list[Wall]:
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
    level = max(float(np.hypot(normal[0], normal[1])), 1.0 - _MAX_LEAN)
    by_hesse = np.zeros((2, 4))  # of (alpha, rho): the wall's normal points into it, the landmark's out of it
    by_hesse[0, :2] = np.array((-normal[1], normal[0])) / level**2
    by_hesse[1, 3] = -1.0 / level
    body_T_plane = body_T_world @ landmarks.placed(landmark.id).world_T_plane
    corners = lift(landmark.region.corners, body_T_plane)[:, :2]
    alpha = float(np.arctan2(-normal[1], -normal[0]))
    along = corners @ np.array((-np.sin(alpha), np.cos(alpha)))
    ends = corners[[int(np.argmin(along)), int(np.argmax(along))]]
    return Wall(alpha, -d / level, by_hesse @ covariance @ by_hesse.T, ends)


def disjoint(pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those pairs whose landmarks are in no pair before them."""
    used: set[int] = set()
    chosen = []
    for pair in pairs:
        if used.isdisjoint(pair):
            chosen.append(pair)
            used.update(pair)
    return chosen
