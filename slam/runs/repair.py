"""Repair: where the verdict says that a map is wrong, all of the drive is held against all of it, and mapped again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from factors._conventions import POSE3_TO_SP
from slam.backend.joint_covariance import carried
from slam.diagnostics.evidence import assess_run
from slam.diagnostics.verdict import Verdict
from slam.diagnostics.views import TOLERANCE_M
from slam.frontend.keyframes import Keyframe
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import inverse
from slam.joining.join import SIGNIFICANCE, Progress
from slam.joining.mission import FinishedMission, Mission
from slam.joining.overlap import compare_missions
from slam.loop_closure.whole_drive import Agreement, agreement
from slam.planeslam import PlaneSlam
from slam.registration.relocalization import are_one
from slam.runs.lost_stretches import found_stretches
from slam.sensors.rig import Rig
from slam.session.prior_map import PriorMap
from slam.session.replay import ForgottenKeyframes, Places
from spplanes.spmodel import PLANE, rpy_from_transform, transform_from_rpy

#: Verdicts, the better first.
_GRADES = ("sound", "doubtful", "broken")


@dataclass(frozen=True)
class Repair:
    """What was done to a run after its end."""

    places: int
    """Pairs of keyframes that the drive as a whole has in one place, and that the map was made anew with."""
    moved: int
    """Those that the map before had elsewhere, by more than a map may err."""
    offset_m: float
    """The farthest of them, or the start in the prior map, m."""
    before: str
    """The verdict on the map before, in one line."""
    planes: int = 0
    """Planes of the prior map that the drive, mapped without it, has too, and that gave its start; 0: it was kept."""
    stretches: int = 0
    """Places that are of stretches which nothing tied to what was before; 0: of pairs of keyframes, as said."""

    @property
    def sentence(self) -> str:
        """For people."""
        if self.planes:
            return (
                f"repaired: by {self.planes} planes of the prior map that the drive alone has too, it started "
                f"{self.offset_m:.2g} m from where that was said; before, {self.before}"
            )
        if self.stretches:
            return (
                f"repaired: {self.stretches} of the stretches that nothing tied to what was before were found there by "
                f"scans that agree, up to {self.offset_m:.2g} m from where they lay; before, {self.before}"
            )
        return (
            f"repaired: {self.moved} of {self.places} places that the drive passed again lay up to {self.offset_m:.2g} "
            f"m from where all of it together has them; before, {self.before}"
        )


class Repaired(NamedTuple):
    """The estimator, the verdict on its map (None: not asked for, nothing would be done about it), and the repairs."""

    slam: PlaneSlam
    verdict: Verdict | None
    repairs: tuple[Repair, ...]


class _Alternative(NamedTuple):
    """Another way to explain a drive: places by the later keyframe, the start in a prior map, what it would mend."""

    places: Places
    prior: PriorMap | None
    repair: Repair


def repaired(slam: PlaneSlam, rig: Rig, progress: Progress | None = None) -> Repaired:
    """The verdict on a run that has ended, and the run mended where it is not sound and the drive tells how.

    The other way to explain the drive is the one that all stretches of it agree on when each is held against each
    (`slam.loop_closure.whole_drive`), for drives with level lasers on a floor; where stretches of 3D scans lie which
    nothing ties to what was before (`slam.runs.lost_stretches`); in a prior map, the start from which the map of the
    drive alone lies on it (`slam.joining.overlap`). Where places are elsewhere by that, the keyframes are
    mapped again with these known. The new map is kept where the evidence speaks less against it, and mended again.
    """
    if not is_open_to_repair(slam) or (slam.prior is None and not _may_tell(slam)):
        return Repaired(slam, None, ())  # what the verdict would say changes nothing: who reads it asks for it
    verdict = assessed(slam, rig)
    repairs: list[Repair] = []
    while verdict.verdict != "sound" and len(repairs) < 3:
        if slam.prior is None:
            found = _other_places(slam, verdict) or _other_stretches(slam, verdict)
        else:
            found = _other_start(slam, slam.prior, rig, verdict, progress)
        if found is None:
            break
        other = slam.remap(found.places, found.prior, progress)
        judged = assessed(other, rig)
        if _badness(judged) >= _badness(verdict):
            break
        other.supersede(slam, found.places)
        repairs.append(found.repair)
        slam, verdict = other, judged
    return Repaired(slam, verdict, tuple(repairs))


def _may_tell(slam: PlaneSlam) -> bool:
    """Whether the drive may tell another place of anything: by level lasers, or by scans found by themselves."""
    return bool(slam.unplaced or slam.rivals) or any(frame.returns is not None for frame in slam.keyframes)


def is_open_to_repair(slam: PlaneSlam) -> bool:
    """Whether places or a start may be looked for at all, and the keyframes are in memory."""
    wanted = slam.prior is not None or slam.config.loops.max_candidates > 0
    return wanted and not isinstance(slam.keyframes, ForgottenKeyframes)


def assessed(slam: PlaneSlam, rig: Rig) -> Verdict:
    """The verdict on a run, as a stage of its clock."""
    with slam.clock.stage("verdict"):
        return assess_run(slam, rig)


def _other_places(slam: PlaneSlam, verdict: Verdict) -> _Alternative | None:
    """What all stretches of the drive agree on, where the map has that elsewhere."""
    found = agreement(slam.keyframes, slam.trajectory.poses, slam.config.loops)
    moved = 0 if found is None else int((found.offsets_m > TOLERANCE_M).sum())
    if found is None or not moved:
        return None
    repair = Repair(len(found.proposals), moved, float(found.offsets_m.max()), verdict.line)
    return _Alternative(_places_of(found, slam.keyframes), None, repair)


def _other_stretches(slam: PlaneSlam, verdict: Verdict) -> _Alternative | None:
    """Where stretches lie that nothing ties to what was before, and that scans find there."""
    found = found_stretches(slam, verdict)
    if not found:
        return None
    farthest = max(one.offset_m for one in found)
    repair = Repair(len(found), len(found), farthest, verdict.line, stretches=len(found))
    return _Alternative({one.start: (one.match,) for one in found}, None, repair)


def _other_start(
    slam: PlaneSlam, prior: PriorMap, rig: Rig, verdict: Verdict, progress: Progress | None
) -> _Alternative | None:
    """The start from which the map of the drive alone lies on the prior map, where that is another one."""
    try:
        alone = FinishedMission.of("drive", slam.remap({}, None, progress), rig).mission
    except ValueError:
        return None  # it leaves planes open
    found = compare_missions(Mission.of_prior(prior), alone, slam.config, significance=SIGNIFICANCE)
    if found.verdict != "joined" or found.alignment is None:
        return None
    laid, first = found.alignment, alone.trajectory.poses[0]
    spread = prior.start_covariance + carried(laid.covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)], first)
    start = laid.a_T_b @ first
    if are_one(prior.world_T_start, start, spread, SIGNIFICANCE):
        return None
    off = rpy_from_transform(inverse(prior.world_T_start) @ start)
    lift = off[list(PLANE)]
    if lift @ np.linalg.solve(spread[np.ix_(PLANE, PLANE)], lift) <= chdtri(3, SIGNIFICANCE):
        off[list(PLANE)] = 0.0  # height and tilt were right: what stands on a floor stands there elsewhere too
    repair = Repair(0, 0, float(np.linalg.norm(off[:3])), verdict.line, planes=len(laid.pairs))
    return _Alternative({}, replace(prior, world_T_start=prior.world_T_start @ transform_from_rpy(off)), repair)


def _places_of(found: Agreement, keyframes: Sequence[Keyframe]) -> dict[int, tuple[PlaceMatch, ...]]:
    """What the drive agrees on, by the later keyframe; nothing, where something else was said before."""
    places: dict[int, list[PlaceMatch]] = {index: [] for index, frame in enumerate(keyframes) if frame.places}
    for inferred, proposals in ((False, found.proposals), (True, found.inferred)):
        for proposal in proposals:
            match = PlaceMatch(proposal.old_keyframe, proposal.pose.delta, proposal.pose.covariance, inferred)
            places.setdefault(proposal.keyframe, []).append(match)
    return {keyframe: tuple(matches) for keyframe, matches in places.items()}


def _badness(verdict: Verdict) -> tuple[int, float]:
    """How much speaks against a map: its grade, then how unlikely all that was found is of a sound one, nats."""
    least = np.finfo(float).tiny
    unlikely = -sum(float(np.log(max(one.p_value, least))) for one in verdict.evidence)
    return _GRADES.index(verdict.verdict), unlikely
