"""Probabilities of data association: the posterior over the joint hypotheses that the gates let through."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factors.association.gating import Hypothesis, State, innovations_of
from factors.association.joint_association import JointCompatibility, JointHypothesis

#: Probability of each landmark (its id), and by None that it is none of them.
Posterior = dict[int | None, float]


def posteriors(problem: JointCompatibility, best: JointHypothesis) -> list[Posterior]:
    """What each observation is with which probability, in their order.

    An observation whose match could be another landmark is taken for that one first, and all others are decided anew:
    that moves the pose, and everything moves with it. Joint hypotheses that are left count by their likelihood (Murty's
    ranking by its first members). Within each, an observation is compared with every landmark, and with a plane that is
    none, by the state that knows all *other* matches: the posterior is the sum of those, each with the probability of
    its joint hypothesis. What the gate of new planes refuses counts as none.

    References:
        Neira and Tardos, "Data association in stochastic mapping using the joint compatibility test", IEEE Trans.
        Robotics and Automation 17 (6), 2001.
    """
    gaps = _gaps(problem)
    joint = _distinct([best, *(problem.decide_all(start) for start in _rivals(problem, best, gaps))])
    weighed = [_weigh(problem, one) for one in joint]
    logs = np.array([log_likelihood for log_likelihood, _, _ in weighed])
    kept = np.flatnonzero(logs >= logs.max() - 20.0)  # less than a billionth as likely
    weights = np.exp(logs[kept] - logs.max())
    found: list[Posterior] = [{} for _ in problem.hypotheses]
    for weight, number in zip((weights / weights.sum()).tolist(), kept.tolist(), strict=True):
        _, matched, by_all = weighed[number]
        by_others = dict(_each_left_out(problem.state, list(matched.items())))
        for index, own in enumerate(gaps):
            for landmark, probability in _conditional(problem, index, by_others.get(index, by_all), own).items():
                found[index][landmark] = found[index].get(landmark, 0.0) + weight * probability
    return found


def _gaps(problem: JointCompatibility) -> list[dict[int, float]]:
    """How much less likely each landmark is for where an observation lies than the nearest that passes, in nats.

    An observation that may be one landmark or none is as likely of it a metre on: a wall goes on.
    """
    gaps = []
    for index, hypotheses in enumerate(problem.hypotheses):
        landmarks = [hypothesis.candidate.landmark for hypothesis in hypotheses]
        away = {landmark: problem.gaps.away(index, landmark) for landmark in landmarks}
        passing = [
            away[innovation.candidate.landmark]
            for innovation in innovations_of(hypotheses, problem.state)
            if innovation.candidate.p_value >= problem.gates.significance
        ]
        least = min(passing, default=0.0)
        gaps.append({landmark: max(one - least, 0.0) for landmark, one in away.items()})
    return gaps


def _rivals(
    problem: JointCompatibility, best: JointHypothesis, gaps: Sequence[dict[int, float]]
) -> list[tuple[int, int]]:
    """Observations and other landmarks that they could be before anything is decided, the likeliest first.

    At most 32: each is a scan decided anew.
    """
    rivals = []
    for index, hypotheses in enumerate(problem.hypotheses):
        taken, innovations = best.decisions[index].landmark, innovations_of(hypotheses, problem.state)
        none, candidates = problem.log_likelihood_of_none(index, innovations), [one.candidate for one in innovations]
        passing = [
            (one.log_likelihood - gaps[index][one.landmark], one.landmark)
            for one in candidates
            if one.p_value >= problem.gates.significance and one.log_likelihood >= none
        ]
        most = max((log for log, _ in passing), default=0.0)
        rivals += [(most - log, index, landmark) for log, landmark in passing if landmark != taken]
    return [(index, landmark) for _, index, landmark in sorted(rivals)[:32]]


def _distinct(joint: Sequence[JointHypothesis]) -> list[JointHypothesis]:
    """Joint hypotheses without those that say what one before them says."""
    known: dict[tuple[int | None, ...], JointHypothesis] = {}
    for one in joint:
        known.setdefault(tuple(decision.landmark for decision in one.decisions), one)
    return list(known.values())


def _weigh(problem: JointCompatibility, joint: JointHypothesis) -> tuple[float, dict[int, Hypothesis], State]:
    """Log likelihood of a joint hypothesis; which observations are a landmark by it; the state that knows them all."""
    matched: dict[int, Hypothesis] = {}
    state, total = problem.state.copy(), 0.0
    for index, hypotheses in enumerate(problem.hypotheses):
        for hypothesis in (one for one in hypotheses if one.candidate.landmark == joint.decisions[index].landmark):
            innovation = state.innovation(hypothesis)
            total += problem.log_likelihood(index, innovation.candidate)
            state.condition(innovation)
            matched[index] = hypothesis
    for index, hypotheses in enumerate(problem.hypotheses):
        if index not in matched:
            total += problem.log_likelihood_of_none(index, innovations_of(hypotheses, state))
    return total, matched, state


def _each_left_out(state: State, matched: Sequence[tuple[int, Hypothesis]]) -> Iterator[tuple[int, State]]:
    """Of every match, the state that knows all others: half and half, n log n updates for n matches."""
    if len(matched) == 1:
        yield matched[0][0], state
    if len(matched) <= 1:
        return
    half = len(matched) // 2
    for inside, outside in ((matched[:half], matched[half:]), (matched[half:], matched[:half])):
        without = state.copy()
        for _, hypothesis in outside:
            without.condition(without.innovation(hypothesis))
        yield from _each_left_out(without, inside)


def _conditional(problem: JointCompatibility, index: int, state: State, gaps: dict[int, float]) -> Posterior:
    """Posterior of one observation by a state."""
    innovations = innovations_of(problem.hypotheses[index], state)
    logs: Posterior = {None: problem.log_likelihood_of_none(index, innovations)}
    for candidate in (innovation.candidate for innovation in innovations):
        if candidate.p_value >= problem.gates.new_significance:
            logs[candidate.landmark] = candidate.log_likelihood - gaps[candidate.landmark]
    most = max(logs.values())
    shares = {landmark: float(np.exp(log - most)) for landmark, log in logs.items()}
    total = sum(shares.values())
    return {landmark: share / total for landmark, share in shares.items()}
