"""Decisions of data association: the landmarks an observation was compared with, and what becomes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.special import chdtrc

from factors.association.gates import AssociationGates

#: Where two landmarks could both be it, one that was seen this much farther from the observation is e times less
#: likely, m: a level laser's line half a metre below a notice-board is of the wall behind the board.
OUTLINE_GAP_SCALE_M = 0.2


@dataclass(frozen=True)
class Candidate:
    """A landmark that an observation was compared with."""

    landmark: int
    """Its id."""
    chi2: float
    """Squared Mahalanobis distance between measured and predicted plane, with state and measurement covariance."""
    dof: int
    """Degrees of freedom: 3 for a plane, 2 for a line."""
    log_likelihood: float
    """Log density of the measurement under this landmark, per rad (of a plane: rad^2) and m."""
    confirmed: bool
    """Whether more than one keyframe has seen the landmark."""

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if it is the same plane."""
        return float(chdtrc(self.dof, max(self.chi2, 0.0)))


@dataclass(frozen=True)
class Decision:
    """What became of one observation, and why."""

    observation: int
    """Index of the observation in its keyframe."""
    verdict: Literal["match", "new", "unsure"]
    """match: one plane with a landmark; new: none of them; unsure: neither can be said, so it is not used."""
    match: Candidate | None
    """The accepted candidate of a match."""
    candidates: tuple[Candidate, ...]
    """All landmarks it was compared with, most likely first; a confirmed one that passes goes before the others."""


def decide(
    index: int,
    candidates: Sequence[Candidate],
    chance: float,
    away: Callable[[int], float],
    gates: AssociationGates,
) -> Decision:
    """The decision about an observation by its candidates.

    Args:
        index: the observation.
        candidates: most likely first.
        chance: log density of other planes about the observation.
        away: how much less likely, in nats, a landmark (its id) is for where the observation lies.
        gates: when a match is one.
    """
    accepted = [
        candidate
        for candidate in candidates
        if candidate.p_value >= gates.significance and candidate.log_likelihood >= chance
    ]
    if len(accepted) > 1:
        accepted.sort(key=lambda one: away(one.landmark) - one.log_likelihood)
    if accepted:
        # a landmark that one look made may be a bad copy of a known one: it must not take the known one's measurements
        best = next((candidate for candidate in accepted if candidate.confirmed), accepted[0])
        return Decision(index, "match", best, tuple(candidates))
    near = any(candidate.p_value >= gates.new_significance for candidate in candidates)
    return Decision(index, "unsure" if near else "new", None, tuple(candidates))


def is_open(decision: Decision, away: Callable[[int], float], gates: AssociationGates) -> bool:
    """Whether more knowledge of the pose could change the decision: unsure, or a match that has a rival."""
    match = decision.match
    if match is None:
        return decision.verdict == "unsure"
    rivals = [one for one in decision.candidates if one is not match and one.p_value >= gates.significance]
    if not rivals:
        return False
    least = match.log_likelihood - away(match.landmark) - gates.rival_log_ratio
    return any(one.log_likelihood - away(one.landmark) >= least for one in rivals)
