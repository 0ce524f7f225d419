"""What may become of an observation: the landmarks it was compared with, and the decision by them alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.special import chdtrc

from slam.config import AssociationConfig


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


def decide(index: int, candidates: Sequence[Candidate], chance: float, config: AssociationConfig) -> Decision:
    """The decision by the candidates alone; `chance` is the log density of other planes about the observation."""
    accepted = [
        candidate
        for candidate in candidates
        if candidate.p_value >= config.significance and candidate.log_likelihood >= chance
    ]
    if accepted:
        # a landmark that one look made may be a bad copy of a known one: it must not take the known one's measurements
        best = next((candidate for candidate in accepted if candidate.confirmed), accepted[0])
        return Decision(index, "match", best, tuple(candidates))
    near = any(candidate.p_value >= config.new_significance for candidate in candidates)
    return Decision(index, "unsure" if near else "new", None, tuple(candidates))


def is_open(decision: Decision, config: AssociationConfig) -> bool:
    """Whether more knowledge of the pose could change the decision: unsure, or a match that has a rival."""
    if decision.match is None:
        return decision.verdict == "unsure"
    least = decision.match.log_likelihood - config.rival_log_ratio
    return any(
        candidate is not decision.match
        and candidate.p_value >= config.significance
        and candidate.log_likelihood >= least
        for candidate in decision.candidates
    )
