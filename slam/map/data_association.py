"""Data association: which landmark is it? The joint compatibility of `factors`, asked by a run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from factors.association.decisions import AssociationGates, Candidate, Decision
from factors.association.joint_association import joint_compatibility
from factors.association.observations import Observation
from slam.backend.estimator import Backend
from slam.frontend.odometry import Motion
from slam.map.landmarks import LandmarkMap

__all__ = ["Associate", "Candidate", "Decision", "Hint", "associate"]

#: Data association as `PlaneSlam` calls it: with the arguments of `associate`, which it uses where no other is given.
Associate = Callable[..., list[Decision]]


def associate(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
    gates: AssociationGates,
    hint: Hint | None = None,
    *,
    among: Collection[int] | None = None,
    trusted: Collection[int] | None = None,
) -> list[Decision]:
    """Decide for every observation of a keyframe, in their order, whose pose is already predicted in the graph.

    As `joint_compatibility` does, whose arguments these are; a `hint` is such as all returns give.
    """
    known = None if hint is None else hint.motion.factor(hint.key, pose_key)
    problem = joint_compatibility(
        observations, pose_key, landmarks, backend, gates, known, among=among, trusted=trusted
    )
    return problem.best().decisions


@dataclass(frozen=True, eq=False)
class Hint:
    """What else is known of a keyframe's pose while its observations are told apart: the motion from another pose."""

    key: int
    motion: Motion
