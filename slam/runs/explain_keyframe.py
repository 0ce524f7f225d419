"""Why a keyframe's measurements became what they did: the decisions of a run on disk, replayed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam.association.data_association import Candidate, Decision
from slam.frontend.observations import Observation
from slam.planeslam import PlaneSlam
from slam.session.state import session_path
from slam.session.store import Session


@dataclass(frozen=True, eq=False)
class Explanation:
    """One keyframe of a run."""

    keyframe: int
    """Its index."""
    stamp_ns: int
    """Its time, ns."""
    sentences: list[str]
    """What became of each thing seen, and what the keyframe changed in the map."""
    decisions: list[tuple[Decision, Observation]]
    """The decisions themselves, with what was seen."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "keyframe": self.keyframe,
            "stamp_s": self.stamp_ns * 1e-9,
            "sentences": self.sentences,
            "observations": [_as_json(decision, seen) for decision, seen in self.decisions],
        }


def explain_keyframe(run: Path | str, keyframe: int) -> Explanation:
    """Replay a run's session, reading only, and explain a keyframe.

    Raises:
        SessionError: no session (runs of `demo` and `map` keep none), or a damaged one.
        ValueError: no such keyframe; it is said before anything is replayed.
    """
    with Session.open(session_path(run), read_only=True) as session:
        count = len(session)
    if not 0 <= keyframe < count:
        raise ValueError(f"keyframe: expected an index from 0 to {count - 1}, got {keyframe}")
    with PlaneSlam.open(run, read_only=True) as slam:
        frame = slam.keyframes[keyframe]
        decisions = [(one, frame.observations[one.observation]) for one in slam.decisions[keyframe]]
        return Explanation(keyframe, frame.stamp_ns, slam.explain(keyframe), decisions)


def _as_json(decision: Decision, seen: Observation) -> dict[str, Any]:
    return {
        "observation": decision.observation,
        "kind": seen.kind,
        "points": int(seen.n_points),
        "verdict": decision.verdict,
        "landmark": None if decision.match is None else decision.match.landmark,
        "candidates": [_candidate(one) for one in decision.candidates],
    }


def _candidate(one: Candidate) -> dict[str, Any]:
    return {"landmark": one.landmark, "chi2": one.chi2, "dof": one.dof, "p": one.p_value, "confirmed": one.confirmed}
