"""Stretches of a drive that nothing ties to what was before: their scans are laid on those of before, anywhere.

A camera that saw nothing for seconds, or a wall alone, goes on in a map of its own. What it sees then it has seen from
elsewhere, or some of it in a while: any scan of the stretch may tell where it is, laid on any scan of before as two
clouds are (`slam.runs.scan_pairs`), with no more of a guess than that it stands upright. One pair may tell little, and
be wrong: where pairs agree, all planes and lines of sight of both parts are asked, as of two clouds.

References:
    Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018, for the agreement that is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from math import isqrt
from typing import NamedTuple

import numpy as np

from factors._conventions import SP_TO_POSE3
from factors.association.observations import PlaneObservation
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import carried
from slam.diagnostics.evidence.registration import CloudMatch, judge
from slam.diagnostics.verdict import Verdict
from slam.diagnostics.views import ScanView, compare, scan_views_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import inverse
from slam.planeslam import PlaneSlam
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.plane_registration import matched_under
from slam.registration.relocalization import scan_of, stated
from slam.runs.scan_pairs import Place, are_near, find_place, refined
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.spmodel import rpy_from_transform

#: So many pairs of scans are laid on each other for all stretches together, as many of a stretch as of what was before;
#: where that leaves no two of each, a drive is lost too often.
_PAIRS = 48
#: What is known of a place when it is judged before it is refined: it is where it was found.
_AS_FOUND = 1e-6 * np.eye(6)


class FoundStretch(NamedTuple):
    """A stretch of a drive that was found in what was before."""

    start: int
    """Its first keyframe."""
    match: PlaceMatch
    """Where that is from an earlier one."""
    offset_m: float
    """How far the map has it from there."""


def found_stretches(slam: PlaneSlam, verdict: Verdict) -> list[FoundStretch]:
    """The stretches that begin where a verdict doubts how a scan was placed, and that are found in what was before."""
    starts = [*_lost(slam, verdict), len(slam.keyframes)]
    scans = isqrt(_PAIRS // max(len(starts) - 1, 1))
    if scans < 2:
        return []
    poses, before = slam.trajectory.poses.copy(), list(range(starts[0]))
    found: list[FoundStretch] = []
    for start, end in pairwise(starts):
        stretch = range(start, end)
        known, lost = (_Part.of(slam, poses, frames, scans) for frames in (before, stretch))
        laid = _found(known, lost, poses[start])
        match = None if laid is None else _match(slam, laid, start)
        if laid is None or match is None:
            continue  # nothing of it tells where what comes after is
        off = inverse(poses[start]) @ laid.world_T_start
        found.append(FoundStretch(start, match, float(np.linalg.norm(off[:3, 3]))))
        poses[start:end] = laid.shift @ poses[start:end]
        before += stretch
    return found


def _lost(slam: PlaneSlam, verdict: Verdict) -> list[int]:
    """Keyframes whose scan fits nowhere, or other places nearly as well, ascending: a map of its own begins there."""
    unsure = (one.keyframes for one in verdict.evidence if one.kind == "ambiguity")
    return sorted({*slam.unplaced, *(frame for frames in unsure for frame in frames)} - {0})


class _Laid(NamedTuple):
    """A scan of a stretch laid on one of before."""

    old: int
    new: int
    place: Place
    shift: FloatArray
    """Takes the stretch from where the map has it to there, shape (4, 4)."""
    world_T_start: FloatArray
    """Where it begins then, shape (4, 4)."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of a drive, whose poses hang together."""

    numbers: list[int]
    """A few of its keyframes that have a 3D scan, evenly over all of them, K."""
    keyframes: list[Keyframe]
    """The same."""
    poses: FloatArray
    """Their world_T_body, shape (K, 4, 4)."""
    planes: PlaneArrays
    """What it saw, of every landmark the largest piece, in the world by its poses."""

    @classmethod
    def of(cls, slam: PlaneSlam, poses: FloatArray, frames: Sequence[int], scans: int) -> _Part:
        """Keyframes of a run, at poses (N, 4, 4) of all its keyframes, and so many scans of theirs."""
        seeing = [frame for frame in frames if scan_of(slam.keyframes[frame]) is not None]
        few = np.unique(np.linspace(0, len(seeing) - 1, scans).round().astype(int)).tolist() if seeing else []
        mine, planes = set(frames), list[Plane]()
        for landmark in slam.landmarks:
            seen = [(one.keyframe, one.observation) for one in landmark.sightings if one.keyframe in mine]
            pieces = [(frame, slam.keyframes[frame].observations[number]) for frame, number in seen]
            of_planes = [(one.n_points, frame, one.plane) for frame, one in pieces if isinstance(one, PlaneObservation)]
            if of_planes:
                _, frame, plane = max(of_planes, key=lambda one: one[0])
                planes.append(plane.transform(poses[frame]))
        numbers = [seeing[k] for k in few]
        return cls(numbers, [slam.keyframes[one] for one in numbers], poses[numbers], PlaneArrays.of(planes))

    def seen_from(self, shift: FloatArray) -> list[tuple[FloatArray, ScanView]]:
        """Pose (4, 4) and view of each of those keyframes, all of the part shifted in the world by a motion (4, 4)."""
        poses = shift @ self.poses
        return [(poses[k], view) for k, view in scan_views_of(self.keyframes, poses).items()]

    @cached_property
    def seen(self) -> list[tuple[FloatArray, ScanView]]:
        """The same where it is."""
        return self.seen_from(np.eye(4))


def _found(before: _Part, stretch: _Part, world_T_start: FloatArray) -> _Laid | None:
    """The pair of scans that says best where a stretch is, of those that agree; None: no place is beyond doubt."""
    groups: list[list[_Laid]] = []  # by the place at which they have it
    n_old, n_new = len(before.numbers), len(stretch.numbers)
    n = max(n_old, n_new)
    turns = ((i, (i + step) % n) for step in range(n) for i in range(n))
    for i, j in ((i, j) for i, j in turns if i < n_old and j < n_new):
        place = find_place(before.keyframes[i], stretch.keyframes[j])
        if place is None:
            continue
        shift = before.poses[i] @ place.a_T_b @ inverse(stretch.poses[j])
        laid = _Laid(before.numbers[i], stretch.numbers[j], place, shift, shift @ world_T_start)
        group = next((some for some in groups if are_near(some[0].world_T_start, laid.world_T_start)), None)
        if group is None:
            groups.append([laid])
            continue
        group.append(laid)
        best = max(group, key=lambda one: one.place.overlap)
        others = [some[0].shift for some in groups if some is not group]
        if _is_beyond_doubt(before, stretch, best, others):
            return best
    return None


def _is_beyond_doubt(before: _Part, stretch: _Part, laid: _Laid, others: Sequence[FloatArray]) -> bool:
    """Whether all that both parts saw bears out where a stretch was laid, as of two clouds; `others`: other shifts."""
    matched = [matched_under(shift, stretch.planes, before.planes) for shift in (laid.shift, *others)]
    looks = np.zeros((2, 2), dtype=int)
    for (world_T_old, seen), (world_T_new, here) in product(before.seen, stretch.seen_from(laid.shift)):
        old_T_new = inverse(world_T_old) @ world_T_new
        looks += (compare(seen, here, old_T_new), compare(here, seen, inverse(old_T_new)))
    first, second = ((int(confirmed), int(through)) for confirmed, through in looks)
    match = CloudMatch(len(stretch.planes.normals), matched[0], tuple(matched[1:]), (first, second), 0.0)
    return judge(match, _AS_FOUND).verdict == "sound"


def _match(slam: PlaneSlam, laid: _Laid, start: int) -> PlaceMatch | None:
    """Where the first keyframe of a stretch is, by a pair of scans and the way between; None: no plane is in both."""
    fit = refined(slam.keyframes[laid.old], slam.keyframes[laid.new], laid.place)
    if fit is None:
        return None
    new_T_start, spread = slam.backend.relative_pose(pose_symbol(laid.new), pose_symbol(start), read=True)
    covariance = (carried(fit.covariance, new_T_start) + spread)[np.ix_(SP_TO_POSE3, SP_TO_POSE3)]
    return PlaceMatch(laid.old, rpy_from_transform(fit.a_T_b @ new_T_start), stated(covariance))
