"""Joint compatibility: all observations from a pose at once, again where one match shuts out what fits."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import log

import gtsam
import numpy as np

from factors.association.decisions import AssociationGates, Candidate, Decision, decide, is_open
from factors.association.estimate import Estimate, KeyedCovariance, Landmark, PlacedLandmarks
from factors.association.gating import Hypothesis, Innovation, State, elsewhere, hypotheses_of, innovations_of
from factors.association.observations import Observation, PlaneObservation
from factors.association.shortlist import Gaps, bounds_of, log_density, log_parallel_density, shortlist
from factors.plane import get_ready


@dataclass(frozen=True, eq=False)
class JointHypothesis:
    """What all observations from a pose are, taken together."""

    decisions: list[Decision]
    """Of every observation."""
    log_likelihood: float
    """Of all of them: of a match that of its innovation, less how far off the landmark was seen, of everything else
    that of a plane which is no landmark."""


@dataclass(frozen=True, eq=False)
class JointCompatibility:
    """Decides the observations from a pose, the firmest first, the state conditioned on every match."""

    hypotheses: Sequence[Sequence[Hypothesis]]
    """Of every observation: one for each landmark it may be."""
    chances: Sequence[float]
    """Of every observation: log density of other planes about it, turned anyhow."""
    parallel_chances: Sequence[float]
    """Of every observation: log of how many others lie parallel to each of its landmarks, per m."""
    gaps: Gaps
    """How far the landmarks are, as they were seen, from where the observations lie."""
    n_points: Sequence[int]
    """Of every observation: the more the firmer."""
    state: State
    """The state before the observations."""
    honest: State | None
    """The state that chi2 are reported of, where the other one knows a hint."""
    gates: AssociationGates

    def best(self) -> JointHypothesis:
        """The most likely of a few joint hypotheses.

        The firmest observation comes first, so when that one is taken for the wall behind it, a notice-board's wall
        say, the pose goes with it and everything that is the wall no longer fits. Where an observation is left without
        a landmark that it could have had on its own, everything is decided once more with that match first, and the
        joint hypothesis is kept under which all that was seen is likelier.
        """
        first = self.decide_all()
        others = [self.decide_all(match) for match in self._shut_out(first)]
        return max([first, *others], key=lambda one: one.log_likelihood)  # of equals the first

    def log_likelihood(self, index: int, candidate: Candidate) -> float:
        """Of an observation (its index) under a landmark, less how far off that was seen."""
        return candidate.log_likelihood - self.gaps.away(index, candidate.landmark)

    def log_likelihood_of_none(self, index: int, innovations: Sequence[Innovation]) -> float:
        """Of an observation (its index) of no landmark that it is compared with, as its innovations are.

        Half of such planes are turned anyhow, half are parallel to one: the worse the pose is known, the likelier is
        what lies beside a landmark another plane, a table for the floor say.
        """
        beside = [self.parallel_chances[index] + innovation.log_parallel for innovation in innovations]
        return float(np.logaddexp.reduce([self.chances[index], *beside])) - log(2.0)

    def decide_all(self, start: tuple[int, int] | None = None) -> JointHypothesis:
        """Decide everything; `start` is an observation and the landmark that it is taken for before all others."""
        state, honest = self.state.copy(), None if self.honest is None else self.honest.copy()
        decisions: dict[int, Decision] = {}
        total = 0.0
        for stage in ("start", "clear", "open"):
            for index in self._firmest_first():
                if index in decisions or (stage == "start" and (start is None or index != start[0])):
                    continue
                found = innovations_of(self.hypotheses[index], state)
                compared, none = [one.candidate for one in found], self._none(index, found)
                if stage == "start" and start is not None:  # all that is seen tells whether others are parallel
                    compared.sort(key=lambda one: one.landmark != start[1])
                    decision = self._decide(index, compared[:1], self.chances[index], state)
                    decision = replace(decision, candidates=tuple(compared))
                else:
                    decision = self._decide(index, compared, none, state)
                if stage == "clear" and is_open(decision, partial(self.gaps.away, index), self.gates):
                    continue
                decision, likelihood = self._take_in(decision, found, none, state, honest)
                decisions[index], total = decision, total + likelihood
        return JointHypothesis([decisions[index] for index in sorted(decisions)], total)

    def _take_in(
        self, decision: Decision, found: Sequence[Innovation], none: float, state: State, honest: State | None
    ) -> tuple[Decision, float]:
        """Condition the states on a match; the decision, unsure where the honest state refuses it, and its share."""
        if decision.match is None:
            return decision, none
        chosen = next(one for one in found if one.candidate is decision.match)
        likelihood = self.log_likelihood(decision.observation, chosen.candidate)
        if honest is not None:
            innovation = honest.innovation(chosen.hypothesis)
            if innovation.candidate.p_value < self.gates.significance:
                return replace(decision, verdict="unsure", match=None), none
            honest.condition(innovation)
            decision = replace(decision, match=innovation.candidate)
        state.condition(chosen)
        return decision, likelihood

    def _shut_out(self, found: JointHypothesis) -> list[tuple[int, int]]:
        """Observations without a landmark that could have had one on their own, with it; four landmarks, each once."""
        tried: dict[int, int] = {}
        for index in self._firmest_first():
            if found.decisions[index].match is not None or not self.hypotheses[index]:
                continue
            candidates = [innovation.candidate for innovation in innovations_of(self.hypotheses[index], self.state)]
            match = self._decide(index, candidates, self.chances[index], self.state).match
            if match is not None:
                tried.setdefault(match.landmark, index)
        return [(index, landmark) for landmark, index in tried.items()][:4]

    def _none(self, index: int, innovations: Sequence[Innovation]) -> float:
        """The likelihood of none as it is decided by: parallel planes lie where the landmark itself was not seen.

        By parallel planes anywhere true matches two sigmas off are refused where little is known of the pose.
        """
        apart = [one for one in innovations if self.gaps.away(index, one.candidate.landmark) > 0.0]
        return max(self.chances[index], self.log_likelihood_of_none(index, apart))

    def _decide(self, index: int, candidates: Sequence[Candidate], none: float, state: State) -> Decision:
        away, within = partial(self.gaps.away, index), partial(self.gaps.within, index, state=state)
        return decide(index, candidates, none, away, within, self.gates)

    def _firmest_first(self) -> list[int]:
        return sorted(range(len(self.n_points)), key=lambda i: (-self.n_points[i], i))


def joint_compatibility(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: PlacedLandmarks[Landmark],
    estimate: Estimate,
    gates: AssociationGates,
    hint: gtsam.NonlinearFactor | None = None,
    *,
    among: Collection[int] | None = None,
    trusted: Collection[int] | None = None,
) -> JointCompatibility:
    """The problem of which landmark each observation is of, from a pose that is already predicted in the graph.

    The chi2 is the factor's own: with A, b its whitened linearisation and P the joint marginal covariance of pose,
    anchors and landmarks, chi2 = r^T (A P A^T + I)^-1 r, r = b - A m. So the gate tests exactly what the graph will be
    told. The firmest observation is decided first, and mean m and covariance P are conditioned on every match before
    the next is judged: what is accepted is jointly compatible, and each chi2 is an innovation of its own. What could be
    two landmarks, a wall or the notice-board on it, waits until all that is clear has been taken in. Where a match
    shuts out others, `JointCompatibility.best` weighs it against them.

    With a `hint`, a factor of the pose that is not in the graph, the decisions are made by a state that knows it; the
    chi2 they are gated by and report is that of the state without it, for the hint is made of the same returns. Factors
    are linearised where it leads: what is neglected from a badly known heading on is many sigmas of a long wall.
    Only the landmarks `among` are looked at when it is given, and only for the observations `trusted`.
    """
    world_T_body = estimate.pose(pose_key)
    bounds = bounds_of(observations, estimate.covariance(pose_key), gates)
    near = [shortlist(one, landmarks, world_T_body) for one in bounds]
    chances = [log_density(one, len(found), gates) for one, found in zip(bounds, near, strict=True)]
    parallel = [log_parallel_density(one, len(found), gates) for one, found in zip(bounds, near, strict=True)]
    shortlists = [
        [one for one in found if (trusted is None or index in trusted) and (among is None or one.id in among)]
        for index, found in enumerate(near)
    ]
    compared = [one for found in shortlists for one in found]
    keys = {key for one in compared for key in (one.key, one.anchor_key) if key is not None}
    ordered = sorted({pose_key, *keys, *([] if hint is None else hint.keys())})
    joint, values = estimate.joint_covariance(ordered), estimate.values_of(ordered)  # once: cheaper than for each pair
    get_ready([one.plane for one in observations if isinstance(one, PlaneObservation)])
    gaps = Gaps(observations, landmarks, pose_key, estimate, joint, gates)
    informed, honest, change = _informed(joint, hint, values), None, None
    if hint is not None:
        honest, change = State(joint), informed.mean[joint.columns([pose_key])]
    there, pairs = elsewhere(values, pose_key, change), zip(observations, shortlists, strict=True)
    hypotheses = [hypotheses_of(one, found, pose_key, joint, there, estimate, change) for one, found in pairs]
    n_points = [observation.n_points for observation in observations]
    return JointCompatibility(hypotheses, chances, parallel, gaps, n_points, informed, honest, gates)


def _informed(joint: KeyedCovariance, hint: gtsam.NonlinearFactor | None, values: gtsam.Values) -> State:
    """The state with what is known of the pose beside the observations."""
    state = State(joint)
    if hint is not None:
        linear = hint.linearize(values)
        jacobian, target = linear.jacobian()
        blank = Candidate(-1, 0.0, len(target), 0.0, False)
        columns = joint.columns(list(linear.keys()))
        state.condition(state.innovation(Hypothesis(blank, columns, jacobian, target, np.zeros(len(target)))))
    return state
