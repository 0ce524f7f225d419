"""Decisions of data association: the gates, the landmarks an observation was compared with, what becomes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from scipy.special import chdtrc

from spplanes._check import as_number


@dataclass(frozen=True)
class AssociationGates:
    """When a measured plane is the landmark's plane.

    Raises:
        ValueError: a significance outside (0, 1), a factor or an angle that is not positive, a negative bound.
    """

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    significance: float = 1e-3
    """A match is accepted below the chi2 quantile 1 - significance: one true match in 1 / significance is missed."""
    new_significance: float = 1e-6
    """A measurement starts a landmark only when every candidate lies above this quantile; between, it is unsure."""
    chance_factor: float = 1.0
    """A match must be likelier than a plane there by chance, turned anyhow or, beside where the landmark was seen,
    parallel to it; how dense planes lie is taken from the landmarks about the observation, times this."""
    rival_log_ratio: float = 4.6
    """A match waits while another landmark is at most exp(this) times less likely: 100 to 1."""
    max_angle_rad: float = 0.35
    """Normals further apart than this, plus `bound_sigmas` of the state, are not compared, rad."""
    gap_m: float = 1.5
    """Patches of one wall may lie this far apart beside the state's own uncertainty, m: more than a door is wide."""
    bound_sigmas: float = 3.0
    """Standard deviations of the pose by which the bounds are wider, before chi2 decides."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = as_number(field.name, getattr(self, field.name))
            if field.name in ("significance", "new_significance"):
                if not 0.0 < value < 1.0:
                    raise ValueError(f"{field.name}: expected a probability between 0 and 1, got {value}")
            elif field.name in ("chance_factor", "max_angle_rad"):
                if value <= 0.0:
                    raise ValueError(f"{field.name}: expected a positive number, got {value}")
            elif value < 0.0:
                raise ValueError(f"{field.name}: expected a number >= 0, got {value}")


@dataclass(frozen=True)
class Candidate:
    """A landmark that an observation was compared with."""

    landmark: int
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

    @property
    def landmark(self) -> int | None:
        """That of a match."""
        return None if self.match is None else self.match.landmark


def decide(
    index: int,
    candidates: Sequence[Candidate],
    none: float,
    away: Callable[[int], float],
    within: Callable[[int], bool],
    gates: AssociationGates,
) -> Decision:
    """The decision about an observation by its candidates.

    Args:
        index: the observation.
        candidates: most likely first.
        none: log likelihood that the observation is of none of them.
        away: how much less likely, in nats, a landmark (its id) is for where the observation lies.
        within: whether a landmark (its id) was seen so near that the observation may be of it.
        gates: when a match is one.
    """
    accepted = [
        candidate
        for candidate in candidates
        if candidate.p_value >= gates.significance and candidate.log_likelihood >= none and within(candidate.landmark)
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
    least = match.log_likelihood - away(match.landmark) - gates.rival_log_ratio
    return any(
        rival.log_likelihood - away(rival.landmark) >= least
        for rival in decision.candidates
        if rival is not match and rival.p_value >= gates.significance
    )
