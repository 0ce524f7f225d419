"""Data association for a graph of one's own: which landmark each observation is of, with probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from factors._check import as_list
from factors.association.decisions import AssociationGates, Candidate, Decision
from factors.association.estimate import PlacedLandmarks
from factors.association.grouping import group_planes
from factors.association.joint_association import joint_compatibility
from factors.association.landmark_extents import LandmarkExtents, place_all
from factors.association.observations import Observation, as_observation
from factors.association.prediction import Prediction
from factors.association.probabilities import Posterior, posteriors
from spplanes import Plane
from spplanes._check import as_number, as_positive, check_instance


@dataclass(frozen=True, eq=False)
class Identity:
    """What one observation is."""

    observation: int
    """Its index."""
    verdict: Literal["match", "new", "unsure"]
    """match: one plane with a landmark; new: none of them; unsure: neither can be said, so it should not be used."""
    plane_key: int | None
    """The landmark of a match; None otherwise."""
    probability: float
    """Of a match, that it is that landmark; of a new plane, that it is none; of an unsure one, of the likeliest."""
    probabilities: Posterior
    """Probability of each landmark that it may be, by key, and by None that it is none of them; they sum to 1."""
    candidates: tuple[Candidate, ...]
    """Landmarks that it was compared with, chi2 and all, as of when it was decided; the most likely first."""


@dataclass(frozen=True, eq=False)
class Association:
    """What all observations from one pose are, taken together."""

    identities: tuple[Identity, ...]
    """One for each observation, in their order."""
    new_planes: tuple[tuple[int, ...], ...]
    """The observations that are new, gathered into those that are one plane; the first of each is the largest."""

    @cached_property
    def matches(self) -> tuple[Identity, ...]:
        """Those that are a landmark."""
        return tuple(identity for identity in self.identities if identity.verdict == "match")

    @cached_property
    def new(self) -> tuple[Identity, ...]:
        """Those that are none of the landmarks."""
        return tuple(identity for identity in self.identities if identity.verdict == "new")

    @cached_property
    def unsure(self) -> tuple[Identity, ...]:
        """Those of which neither can be said."""
        return tuple(identity for identity in self.identities if identity.verdict == "unsure")


def associate(
    observations: Sequence[Observation | Plane],
    prediction: Prediction,
    landmarks: LandmarkExtents,
    *,
    gates: AssociationGates | None = None,
    least_probability: float = 0.0,
    wall_tilt_sigma_rad: float = 0.01,
) -> Association:
    """Decide which landmark each observation of a pose is of, before any of them is in the graph.

    By joint compatibility, as in `slam`: every observation's own factor is held against the joint covariance of pose,
    anchors and landmarks; the firmest is decided first, and the state is conditioned on every match before the next is
    judged; where landmarks lie where they were seen counts between rivals. The result does not depend on the order of
    observations or landmarks.

    Args:
        observations: planes in the body frame, normals toward the sensor, or `PlaneObservation`, `LineObservation`.
        prediction: the pose, in the graph by odometry say, with joint covariances.
        landmarks: what was seen of each landmark; all of them are in the prediction's values.
        gates: significances and bounds; by default `AssociationGates()`.
        least_probability: a verdict less probable than this, in [0, 1], is unsure; by default the verdicts of the gates
            stay as they are, those of `slam`.
        wall_tilt_sigma_rad: how far new walls seen by lines may lean from the scan plane's normal, rad, where two of
            them are held against each other.

    Returns:
        For each observation a verdict, its probability, and that of every landmark it may be.

    Raises:
        ValueError: what is no observation, a singular covariance, landmarks or anchors that are not in the prediction's
            values, covariances that are not finite, a probability outside [0, 1], a tilt that is not positive.
    """
    check_instance("prediction", prediction, Prediction)
    check_instance("landmarks", landmarks, LandmarkExtents)
    least = as_number("least_probability", least_probability)
    if not 0.0 <= least <= 1.0:
        raise ValueError(f"least_probability: expected a number from 0 to 1, got {least}")
    gates = AssociationGates() if gates is None else gates
    check_instance("gates", gates, AssociationGates)
    tilt_rad = as_positive("wall_tilt_sigma_rad", wall_tilt_sigma_rad)
    seen = [as_observation(f"observations[{i}]", one) for i, one in enumerate(as_list("observations", observations))]

    order = sorted(range(len(seen)), key=lambda index: _rank(seen[index]))  # ties must not go by the order given
    known = list(landmarks)
    placed = PlacedLandmarks({one.key: one for one in known}, place_all(known, prediction.values))
    problem = joint_compatibility([seen[index] for index in order], prediction.pose_key, placed, prediction, gates)
    best = problem.best()
    identities = {
        index: _identity(index, best.decisions[rank], posterior, least)
        for rank, (index, posterior) in enumerate(zip(order, posteriors(problem, best), strict=True))
    }
    new = [index for index, identity in identities.items() if identity.verdict == "new"]
    groups = group_planes([seen[index] for index in new], gates, tilt_rad, [True] * len(new))
    new_planes = tuple(tuple(new[member] for member in group) for group in groups)
    return Association(tuple(identities[index] for index in range(len(seen))), new_planes)


def _rank(observation: Observation) -> tuple[float, ...]:
    """By what an observation is: the firmest first."""
    return (-observation.n_points, *observation.normal.tolist(), *observation.vertices.mean(axis=0).tolist())


def _identity(index: int, decision: Decision, posterior: Posterior, least: float) -> Identity:
    """The verdict on an observation, unsure where it is less probable than it has to be."""
    probability = posterior.get(decision.landmark, 0.0)
    if decision.verdict != "unsure" and probability >= least:
        return Identity(index, decision.verdict, decision.landmark, probability, posterior, decision.candidates)
    likeliest = max(posterior.values())
    return Identity(index, "unsure", None, likeliest, posterior, decision.candidates)
