"""Relocalization: a body whose motion is hardly known finds its place before its observations are matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.special import chdtri, erf, erfc

from factors import relative_pose_factor
from factors._conventions import POSE3_TO_SP
from factors.association.observations import Observation, PlaneObservation, planes_of
from slam.backend.estimator import pose_symbol
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.frontend.scan_surfaces import ITS_OWN, ON_PLANE
from slam.geometry.frames import inverse
from slam.geometry.polygons import polygonal
from slam.map.landmarks import Landmark, LandmarkMap
from slam.map.state import EstimatorState
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.motion_prior import MotionPrior
from slam.registration.plane_registration import (
    PlaneMatching,
    chance_of,
    matched_under,
    pairs_under,
    places_anywhere,
    register_planes_globally,
)
from slam.registration.surface_registration import TELLING, WEAK_PRIOR, Alignment, Expected, LocalMap, Tried, align
from slam.registration.visibility import Scan
from spplanes import Plane
from spplanes._check import FloatArray

#: A motion known worse than this is looked for by the planes, m and rad.
_WIDE_M, _WIDE_RAD = 0.25, 0.12
#: Landmarks that so many keyframes before have seen are looked for.
_RECENT = 6
#: What least squares over pairs leaves out, segmentation above all, against its covariance: factor, and least, m, rad.
_SLACK, _LEAST_M, _LEAST_RAD = 1.5, 0.02, 0.004
#: Score (`Alignment.score`) at which what a scan sees is as likely something never seen before. The best places of 21
#: scans of hand-held cameras in another room, or where they had not looked yet, scored up to 0.43, 0 in the median; the
#: true places of 10 that had been covered for seconds 0.30 to 0.98, 0.62 in the median.
_BY_CHANCE = 0.35
#: Turns by 14 deg about each axis, either way. In a simulated scene a descent finds back from a yaw of 10 deg and not
#: from 12; with these a camera is found that turned by 24.
_TURNED = [
    gtsam.Pose3(gtsam.Rot3.Expmap(turn), np.zeros(3)).matrix() for turn in 0.25 * np.vstack((np.eye(3), -np.eye(3)))
]


def is_poorly_known(motion: Motion) -> bool:
    """Whether so little is known of a motion that single planes cannot be told apart by it."""
    place, turn = sigmas_of(motion)
    return place > _WIDE_M or turn > _WIDE_RAD


class Rivals(NamedTuple):
    """Other places that what was seen fits as well, or nearly so."""

    probability: float
    """That the body is at one of them."""
    distance_m: float
    """How far the likeliest of them is from where it was placed."""
    angle_rad: float
    """How far it is turned from there."""
    unseen: float = 0.0
    """Of that probability the part that none of it was seen before: it fits where it lies by chance."""


NO_RIVALS = Rivals(0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """Where a body is by the planes it sees again, and by all else that it sees."""

    motion: Motion
    """The motion to there; it stands in for the real one while observations are matched."""
    seen_again: frozenset[int]
    """Indices of the observations that found it."""
    expected: Motion
    """What was known of the motion before, as wide as this body moves: what was seen tells whether it moved on."""
    beyond: Motion | None = None
    """What the returns on none of those planes say of the motion, which no match of theirs says again; None: nothing.
    """
    rivals: Rivals = NO_RIVALS
    """The other places that were looked at."""

    @property
    def trusted(self) -> frozenset[int] | None:
        """Observations that may be matched; None: all.

        Where even the planes leave a place open, a plane that was not seen again there fits any landmark along the
        open direction: the next of a row of pillars as well as the first. Lines, which find no place, wait as well.
        """
        return self.seen_again if is_poorly_known(self.motion) else None

    def factors(self, key_a: int, key_b: int, robust: str | None) -> list[Any]:
        """What stays in the graph of it once the observations are matched."""
        if (beyond := self.beyond) is None:
            return []
        return [relative_pose_factor(key_a, key_b, beyond.a_T_b, beyond.covariance, robust=robust)]  # type: ignore[arg-type]


def found_place(
    keyframe: Keyframe, motion: Motion, state: EstimatorState, prior: MotionPrior | None
) -> FoundPlace | None:
    """The place from which most of what a keyframe sees was seen before; None when that cannot be said.

    Planes propose places, as do the expectation and that nothing moved; each is refined and verified by all returns of
    a 3D scan. Its motion is used for matching observations and for nothing later: it holds what they will say.

    Args:
        keyframe, motion: what is seen, and what is known of its motion.
        state: the keyframes before, the landmarks as of the last refresh, and the graph.
        prior: how likely each motion is, where nobody measured it: places are told apart by that.
    """
    expected_T_world = where_expected(motion, state)
    seen, known = planes_about(keyframe, state, expected_T_world)
    by_planes = register_planes_globally(seen, known, sigmas_of(motion if prior is None else prior.learnt()))
    scan, around = scan_of(keyframe), local_map(state, expected_T_world)
    if scan is not None and around is not None:
        expected = Expected(np.eye(4), information_of(motion), prior)
        found = register_from_hypotheses(scan, around, by_planes, expected, inverse(motion.a_T_b))
        if found.score <= 0.0:
            return None
        covariance = np.linalg.inv(found.information + WEAK_PRIOR).astype(np.float64)
        learnt = _learnt(motion, prior, found.known_T_seen, covariance)
        stamps_ns = [frame.stamp_ns for frame in (*state.keyframes[-_RECENT:], keyframe)]
        unseen = _may_be_unseen(scan.elements, learnt) if is_after_gap(stamps_ns) else 0.0
        return place_of(keyframe, learnt, found, seen, known, unseen)
    if by_planes is None:
        return None
    known_T_seen, covariance = by_planes.known_T_seen, by_planes.covariance
    learnt = _learnt(motion, prior, known_T_seen, covariance)
    return FoundPlace(_stated(motion, known_T_seen, covariance), _numbers(keyframe, by_planes.pairs), learnt)


def place_of(
    keyframe: Keyframe,
    motion: Motion,
    found: Alignment,
    seen: PlaneArrays,
    known: PlaneArrays,
    unseen: float = 0.0,
) -> FoundPlace:
    """The place of a 3D scan that was laid on those before, seen from where a motion leads.

    With the planes it sees, and those seen of late, as `planes_about` gives them; `unseen`: odds, before looking, that
    nothing it sees was seen before.
    """
    information = found.information + information_of(motion)
    there = _stated(motion, found.known_T_seen, np.linalg.inv(information).astype(np.float64))
    seen_again = _numbers(keyframe, pairs_under(found.known_T_seen, seen, known))
    assert keyframe.surfaces is not None  # it was laid
    again = _on(keyframe.surfaces, [keyframe.observations[k] for k in sorted(seen_again)])
    if unseen > 0.0:
        unseen *= max(float(np.exp(TELLING * (_BY_CHANCE - found.score))), _chance(found, there, seen, known))
    rivals = _rivals(found, there.covariance, unseen)
    return FoundPlace(there, seen_again, motion, _beyond(motion, found, ~again), rivals)


def _numbers(keyframe: Keyframe, pairs: Sequence[tuple[int, int]]) -> frozenset[int]:
    """The observations of a keyframe that are in pairs (seen, known) of planes, by their indices."""
    planes = [k for k, observation in enumerate(keyframe.observations) if isinstance(observation, PlaneObservation)]
    return frozenset(planes[i] for i, _ in pairs)


def where_expected(motion: Motion, state: EstimatorState) -> FloatArray:
    """expected_T_world (4, 4) of a body after a motion from the last keyframe."""
    return inverse(state.backend.pose(pose_symbol(len(state.keyframes) - 1)) @ motion.a_T_b)


def planes_about(
    keyframe: Keyframe, state: EstimatorState, expected_T_world: FloatArray
) -> tuple[PlaneArrays, PlaneArrays]:
    """Planes that the next keyframe sees, and those seen of late in the frame where the body is expected."""
    seen, landmarks, index = planes_of(keyframe.observations), state.landmarks, len(state.keyframes)
    recent = [landmark for landmark in landmarks if landmark.was_seen_between(index - _RECENT, index)]
    known = [_placed(one, landmarks).transform(expected_T_world) for one in recent]
    return PlaneArrays.of(seen), PlaneArrays.of(known)


def local_map(state: EstimatorState, expected_T_world: FloatArray) -> LocalMap | None:
    """What the last keyframes saw, in the frame where the body is expected; None: no 3D scans."""
    keyframes, backend = state.keyframes, state.backend
    indices = range(max(len(keyframes) - _RECENT, 0), len(keyframes))
    scans = [(index, scan) for index in indices if (scan := scan_of(keyframes[index])) is not None]
    parts = [(expected_T_world @ backend.pose(pose_symbol(index)), scan) for index, scan in scans]
    return LocalMap(parts) if parts else None


@lru_cache(maxsize=_RECENT + 2)
def scan_of(keyframe: Keyframe) -> Scan | None:
    """The 3D scan of a keyframe, as it is registered; None: there is none, or nothing in it.

    Those of the latest are kept: what each saw is fixed in its body, and asked for at several keyframes after it.
    """
    if keyframe.surfaces is None or not len(keyframe.surfaces):
        return None
    return Scan(keyframe.surfaces, np.zeros(3) if keyframe.viewpoint is None else keyframe.viewpoint)


def _learnt(motion: Motion, prior: MotionPrior | None, known_T_seen: FloatArray, covariance: FloatArray) -> Motion:
    """What is known of a motion before looking: by how this body moves, where it was seen at a place, GTSAM order."""
    if prior is None:
        return motion
    return prior.learnt(displacement(np.eye(4), known_T_seen), covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)])


def register_from_hypotheses(
    scan: Scan, known: LocalMap, by_planes: PlaneMatching | None, expected: Expected, still: FloatArray
) -> Alignment:
    """A scan laid on a local map from where planes propose, from what is expected, and as if nothing moved.

    Where planes propose nothing, also from what is expected turned about each axis: a hand turns a camera by more in an
    image than a descent finds back from.
    """
    there = expected.known_T_seen
    proposed = [there @ turn for turn in _TURNED] if by_planes is None else [by_planes.known_T_seen]
    return align(scan, known, [*proposed, there, still], expected)


def is_after_gap(stamps_ns: Sequence[int]) -> bool:
    """Whether the last of scans came so late that what it sees may never have been seen: twice as late as is usual.

    Whoever records scans does so that each sees something of the one before.
    """
    steps = np.diff(stamps_ns)
    return len(steps) > 1 and bool(steps[-1] > 2.0 * np.median(steps[:-1]))


def _may_be_unseen(elements: FloatArray, motion: Motion) -> float:
    """Odds that what surface elements (N, 9) are of was not seen before a motion of which so much is known.

    That is where the body may be beyond what it sees, as far as half of that is away.
    """
    far = np.median(np.linalg.norm(elements[:, :3], axis=1)) / (np.sqrt(2.0) * sigmas_of(motion)[0])
    return float(erfc(far) / max(erf(far), np.finfo(float).tiny))


def _chance(found: Alignment, there: Motion, seen: PlaneArrays, known: PlaneArrays) -> float:
    """Probability that another place would have as many of the planes seen as the one that was found, and stated.

    By what planes have at the places that they themselves propose, wherever.
    """
    here, proposed = found.known_T_seen, (place for _, place in places_anywhere(seen.planes, known.planes))
    others = [one for one in proposed if not are_one(here, one.known_T_seen, there.covariance, significance=1e-3)]
    elsewhere = [one.n_matched for one in others]
    return chance_of(matched_under(here, seen, known), elsewhere, len(seen.normals))


def _others(found: Alignment, covariance: FloatArray) -> list[Tried]:
    """The other places at which a scan came to rest, none twice; SP covariance (6, 6) of the one that was found."""
    others: list[Tried] = []
    for one in found.tried[1:]:
        places = (found.known_T_seen, *(other.known_T_seen for other in others))
        if not any(are_one(place, one.known_T_seen, covariance, significance=1e-3) for place in places):
            others.append(one)
    return others


def _rivals(found: Alignment, covariance: FloatArray, unseen: float) -> Rivals:
    """The other places that a scan may lie at; SP covariance (6, 6) of the one that was found, odds that none is it."""
    others = _others(found, covariance)
    odds = [float(np.exp(one.log_likelihood - found.tried[0].log_likelihood)) for one in others]
    total = 1.0 + sum(odds) + unseen
    if not odds:
        return Rivals(unseen / total, 0.0, 0.0, unseen / total)
    between = gtsam.Pose3(inverse(found.known_T_seen) @ others[0].known_T_seen)  # the likeliest comes first
    distance_m = float(np.linalg.norm(between.translation()))
    angle_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(between.rotation())))
    return Rivals((sum(odds) + unseen) / total, distance_m, angle_rad, unseen / total)


def are_one(place: FloatArray, other: FloatArray, covariance: FloatArray, significance: float) -> bool:
    """Whether two places (4, 4) may be the same, by the covariance (6, 6) of their difference, SP order."""
    off = displacement(place, other)
    return bool(off @ np.linalg.solve(covariance, off) <= chdtri(6, significance))


def displacement(place: FloatArray, other: FloatArray) -> FloatArray:
    """How far another place (4, 4) is off one, SP order along the axes of that, shape (6,)."""
    return gtsam.Pose3.Logmap(gtsam.Pose3(inverse(place) @ other))[POSE3_TO_SP].astype(np.float64)


def _on(elements: FloatArray, observations: Sequence[Observation]) -> np.ndarray:
    """Which surface elements (N, 9) are on one of some planes, shape (N,): they were laid on their own."""
    planes = planes_of(observations)
    if not planes:
        return np.zeros(len(elements), dtype=bool)
    normals, d = np.array([plane.normal for plane in planes]), np.array([plane.d for plane in planes])
    near = np.abs(elements[:, :3] @ normals.T - d) < ITS_OWN
    alike = elements[:, 3:6] @ normals.T > 1.0 - ITS_OWN
    return (elements[:, 7] == ON_PLANE) & (near & alike).any(axis=1)


def _beyond(motion: Motion, found: Alignment, elements: np.ndarray) -> Motion | None:
    """What some elements, mask (N,), say alone, as a motion whose covariance is wide where they are silent."""
    information, told = found.residuals.told_by(elements)
    if not information.any():
        return None
    information = information / _SLACK**2 + WEAK_PRIOR
    step = gtsam.Pose3.Expmap(np.linalg.solve(information, told / _SLACK**2)).matrix()
    covariance = np.linalg.inv(information).astype(np.float64)[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    return replace(motion, a_T_b=motion.a_T_b @ found.known_T_seen @ step, covariance=covariance, response=None)


def _stated(motion: Motion, known_T_seen: FloatArray, covariance: FloatArray) -> Motion:
    """A motion found, with its covariance (6, 6), GTSAM order, and what that leaves out."""
    return replace(motion, a_T_b=motion.a_T_b @ known_T_seen, covariance=stated(covariance), response=None)


def stated(covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6), SP order, of a motion by least squares with one in GTSAM order, and what that leaves out."""
    least = np.diag(np.repeat([_LEAST_M**2, _LEAST_RAD**2], 3))
    return _SLACK**2 * covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)] + least


def information_of(motion: Motion) -> FloatArray:
    """Information of what is known of a motion before looking, alike in all directions, GTSAM order, (6, 6)."""
    place, turn = sigmas_of(motion)
    return np.diag(1.0 / np.repeat([turn, place], 3) ** 2)


def _placed(landmark: Landmark, landmarks: LandmarkMap) -> Plane:
    """A landmark with all parts that were seen of it: a wall behind pillars has many."""
    frame, outline = landmarks.placed(landmark.id).world_T_plane, polygonal(landmark.outline)
    return Plane._trusted(frame, 1e-6 * np.eye(3), landmark.n_points, outline)  # type: ignore[arg-type]


def sigmas_of(motion: Motion) -> tuple[float, float]:
    """Largest standard deviation of position and of orientation, m and rad."""
    split = 2 if motion.is_planar else 3
    place, turn = motion.covariance[:split, :split], motion.covariance[split:, split:]
    return tuple(float(np.sqrt(np.linalg.eigvalsh(block)[-1])) for block in (place, turn))  # type: ignore[return-value]
