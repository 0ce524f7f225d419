"""Data association as a problem of joint compatibility: its hypotheses, and the state they are held against."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import gtsam

from factors.association.decisions import AssociationGates, Candidate
from factors.association.estimate import Estimate, Joint, Landmark, Landmarks
from factors.association.gaps import Gaps
from factors.association.gating import Hypothesis, State, hypotheses_of
from factors.association.joint_association import JointCompatibility
from factors.association.observations import Observation, PlaneObservation
from factors.association.shortlist import bounds_of, log_density, log_parallel_density, shortlist
from factors.plane import get_ready


def joint_compatibility(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: Landmarks[Landmark],
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
    chi2 they are gated by and report is that of the state without it, for the hint is made of the same returns.

    Only the landmarks `among` are looked at when it is given, and only for the observations `trusted`.
    """
    world_T_body = estimate.pose(pose_key)
    bounds = bounds_of(observations, estimate.covariance(pose_key), gates)
    shortlists = [shortlist(one, landmarks, world_T_body) for one in bounds]
    chances = [log_density(one, len(near), gates) for one, near in zip(bounds, shortlists, strict=True)]
    parallel = [log_parallel_density(one, len(near), gates) for one, near in zip(bounds, shortlists, strict=True)]
    if trusted is not None:
        shortlists = [near if index in trusted else [] for index, near in enumerate(shortlists)]
    if among is not None:
        shortlists = [[landmark for landmark in near if landmark.id in among] for near in shortlists]
    hinted: list[int] = [] if hint is None else list(hint.keys())
    ordered = sorted({pose_key, *_keys_of(shortlists), *hinted})
    joint, values = estimate.joint_covariance(ordered), estimate.values_of(ordered)  # once: cheaper than for each pair
    get_ready([one.plane for one in observations if isinstance(one, PlaneObservation)])
    gaps = Gaps(observations, landmarks, pose_key, estimate, joint, gates)
    return JointCompatibility(
        [
            hypotheses_of(observation, near, pose_key, joint, values, estimate)
            for observation, near in zip(observations, shortlists, strict=True)
        ],
        chances,
        parallel,
        gaps.away,
        gaps.within,
        [observation.n_points for observation in observations],
        state=lambda: _informed(joint, hint, values),
        honest=None if hint is None else lambda: State(joint),
        gates=gates,
    )


def _keys_of(shortlists: Sequence[Sequence[Landmark]]) -> set[int]:
    """Keys of all landmarks that anything is compared with, and of their anchors."""
    landmarks = [landmark for near in shortlists for landmark in near]
    anchors = {landmark.anchor_key for landmark in landmarks if landmark.anchor_key is not None}
    return {landmark.key for landmark in landmarks} | anchors


def _informed(joint: Joint, hint: gtsam.NonlinearFactor | None, values: gtsam.Values) -> State:
    """The state with what is known of the pose beside the observations."""
    state = State(joint)
    if hint is not None:
        linear = hint.linearize(values)
        jacobian, target = linear.jacobian()
        blank = Candidate(-1, 0.0, len(target), 0.0, False)
        columns = joint.columns(list(linear.keys()))
        state.condition(state.innovation(Hypothesis(blank, columns, jacobian, target)))
    return state
