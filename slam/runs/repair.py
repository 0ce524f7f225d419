"""Repair: where the verdict says that a map is wrong, all of the drive is held against all of it, and mapped again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slam.diagnostics.evidence import assess_run
from slam.diagnostics.verdict import Verdict
from slam.diagnostics.views import TOLERANCE_M
from slam.frontend.keyframes import Keyframe
from slam.frontend.pose_measurements import PlaceMatch
from slam.loop_closure.whole_drive import Agreement, agreement
from slam.planeslam import PlaneSlam
from slam.sensors.rig import Rig
from slam.session.replay import ForgottenKeyframes

#: A map is mended again while that makes it better, at most so often.
_ROUNDS = 3
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
    """The farthest of them, m."""
    before: str
    """The verdict on the map before, in one line."""

    @property
    def sentence(self) -> str:
        """For people."""
        return (
            f"repaired: {self.moved} of {self.places} places that the drive passed again lay up to {self.offset_m:.2g} "
            f"m from where all of it together has them; before, {self.before}"
        )


class Repaired(NamedTuple):
    """A run, its verdict, and what was done to it."""

    slam: PlaneSlam
    """The estimator, the one that was where nothing was repaired."""
    verdict: Verdict | None
    """On its map; None: it was not asked for, for nothing would have been done about it."""
    repairs: tuple[Repair, ...]
    """One after the other."""


def repaired(slam: PlaneSlam, rig: Rig, progress: Callable[[int, int], None] | None = None) -> Repaired:
    """The verdict on a run that has ended, and the run mended where it is not sound and the drive tells how.

    The verdict names what contradicts the map. The other way to explain the drive is the one that all stretches of it
    agree on when each is held against each (`slam.loop_closure.whole_drive`): where places are elsewhere by that, the
    keyframes are mapped again with these places known. The new map is kept where the evidence speaks less against it,
    and mended again until nothing gets better. Drives with level lasers on a floor are; what is localised in a prior
    map is not.
    """
    if not is_open_to_repair(slam) or all(frame.returns is None for frame in slam.keyframes):
        return Repaired(slam, None, ())  # what the verdict would say changes nothing: who reads it asks for it
    with slam.clock.stage("verdict"):
        verdict = assess_run(slam, rig)
    repairs: list[Repair] = []
    while verdict.verdict != "sound" and len(repairs) < _ROUNDS:
        found = agreement(slam.keyframes, slam.trajectory.poses, slam.config.loops)
        moved = 0 if found is None else int((found.offsets_m > TOLERANCE_M).sum())
        if found is None or not moved:
            break
        places = _places_of(found, slam.keyframes)
        other = slam.remap(places, progress)
        with slam.clock.stage("verdict"):
            judged = assess_run(other, rig)
        if _badness(judged) >= _badness(verdict):
            break
        other.supersede(slam, places)
        repairs.append(Repair(len(found.proposals), moved, float(found.offsets_m.max()), verdict.line))
        slam, verdict = other, judged
    return Repaired(slam, verdict, tuple(repairs))


def is_open_to_repair(slam: PlaneSlam) -> bool:
    """Whether loops are looked for at all, nothing but the drive itself says where it was, and it is in memory."""
    return (
        slam.config.loops.max_candidates > 0
        and slam.prior is None
        and not isinstance(slam.keyframes, ForgottenKeyframes)
    )


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
