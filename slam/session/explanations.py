"""What became of a keyframe's observations, and what a keyframe changed in the map, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from factors.association.observations import Observation
from slam.loop_closure.closing import ClosedLoop
from slam.loop_closure.verification import LoopDecision
from slam.map.data_association import Decision
from slam.mapping.fusion import Merge


def decision_sentence(decision: Decision, observation: Observation) -> str:
    """What became of an observation, and what it was compared with, likeliest first."""
    what = f"{observation.kind} {decision.observation} ({observation.n_points} points)"
    likeliest = [
        f"landmark {one.landmark} chi2 {one.chi2:.1f} of {one.dof} dof (p {one.p_value:.2g})"
        for one in decision.candidates[:3]
    ]
    compared = ", ".join(likeliest) or "no landmark near"
    if decision.match is not None:
        return f"{what} is landmark {decision.match.landmark}: {compared}"
    if decision.verdict == "new":
        return f"{what} is none of the landmarks: {compared}"
    return f"{what} is not used, it may be one and may be none: {compared}"


def change_sentences(
    keyframe: int, merges: Iterable[Merge], loops: Sequence[LoopDecision], closed: Iterable[ClosedLoop]
) -> list[str]:
    """What a keyframe changed in the map: merges, merges taken back, loops looked for, loops taken back."""
    sentences = []
    for merge in merges:
        if merge.keyframe == keyframe:
            sentences.append(f"landmark {merge.younger} became part of landmark {merge.older} ({merge.cause})")
        if merge.undone == keyframe:
            sentences.append(f"landmark {merge.younger} was found not to be landmark {merge.older} after all")
    for loop in loops:
        if loop.keyframe == keyframe:
            sentences.append(f"compared with the surroundings of keyframe {loop.old_keyframe}: {loop.verdict}")
    for known in closed:
        if known.undone == keyframe:
            ends = known.loop.keyframe, known.loop.old_keyframe
            sentences.append("keyframe {} was found not to have come back to the place of keyframe {}".format(*ends))
    return sentences
