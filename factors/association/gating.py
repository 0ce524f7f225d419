"""Gating: observations compared with a state by innovations, their chi2 and likelihood; the Kalman update by them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from math import log, pi
from typing import NamedTuple

import gtsam
import numpy as np

from factors.association.decisions import Candidate
from factors.association.estimate import Estimate, KeyedCovariance, Landmark, observation_factor
from factors.association.observations import Observation
from spplanes._check import FloatArray

_LOG_2PI = log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A linearised factor of an observation under the assumption that it is a certain landmark."""

    candidate: Candidate
    """Its log likelihood is that of no error and no spread yet."""
    columns: np.ndarray
    jacobian: FloatArray
    target: FloatArray
    by_distance: FloatArray
    """Derivative of the whitened error by the landmark's distance, per m: what a parallel plane beside it would do."""


@dataclass(frozen=True, eq=False)
class Innovation:
    """A hypothesis compared with a state."""

    candidate: Candidate
    hypothesis: Hypothesis
    residual: FloatArray
    covariance: FloatArray
    log_parallel: float
    """Log likelihood that the observation is of a plane parallel to the landmark, one a metre, anywhere beside it: the
    integral of the innovation's density over the landmark's distance; -inf where the distance changes nothing."""


class State:
    """Mean and covariance of the tangents of all variables that a pose's observations may touch."""

    def __init__(self, joint: KeyedCovariance) -> None:
        self._covariance = joint.full.copy()
        self.mean = np.zeros(len(self._covariance))
        """Of the tangents of all of them, in the order of the joint covariance."""

    def copy(self) -> State:
        """One that goes its own way."""
        return copy(self)  # both matrices are replaced by updates, never written into

    def innovation(self, hypothesis: Hypothesis) -> Innovation:
        """Compare a hypothesis with the state: chi2 and likelihood."""
        expected, spread = self.along(hypothesis.columns, hypothesis.jacobian)
        residual = hypothesis.target - expected
        covariance = spread + np.eye(len(residual))
        found = eliminated(covariance.tolist(), residual.tolist(), hypothesis.by_distance.tolist())
        blank, log_parallel = hypothesis.candidate, -float("inf")
        log_likelihood = blank.log_likelihood - 0.5 * (found.chi2 + found.log_det)
        if found.precision > 0.0:
            log_parallel = log_likelihood + 0.5 * (found.pull**2 / found.precision + _LOG_2PI - log(found.precision))
        candidate = Candidate(blank.landmark, found.chi2, blank.dof, log_likelihood, blank.confirmed)
        return Innovation(candidate, hypothesis, residual, covariance, log_parallel)

    def along(self, columns: np.ndarray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of what a Jacobian (K, C) makes of the tangents of some columns (C,): (K,) and (K, K)."""
        covariance = jacobian @ self._covariance[columns[:, None], columns] @ jacobian.T
        return jacobian @ self.mean[columns], covariance

    def condition(self, innovation: Innovation) -> None:
        """Take an innovation in: the Kalman update."""
        spread = self._covariance[:, innovation.hypothesis.columns] @ innovation.hypothesis.jacobian.T
        gain = np.linalg.solve(innovation.covariance, spread.T).T
        self.mean = self.mean + gain @ innovation.residual
        self._covariance = self._covariance - gain @ spread.T


class Eliminated(NamedTuple):
    """What the density of a residual r, and of r less a multiple of a direction a, is made of; see `eliminated`."""

    chi2: float
    """r^T C^-1 r."""
    log_det: float
    """log det(2 pi C)."""
    pull: float
    """a^T C^-1 r."""
    precision: float
    """a^T C^-1 a."""


def eliminated(covariance: list[list[float]], residual: list[float], direction: list[float]) -> Eliminated:
    """By L D L^T of a symmetric C that is at least the identity, in scalars; the lists are overwritten."""
    chi2, log_det, pull, precision = 0.0, len(residual) * _LOG_2PI, 0.0, 0.0
    for i in range(len(residual)):
        pivot, row, off, slope = covariance[i][i], covariance[i], residual[i], direction[i]
        chi2 += off**2 / pivot
        pull += off * slope / pivot
        precision += slope**2 / pivot
        log_det += log(abs(pivot))
        for j in range(i + 1, len(residual)):
            share = row[j] / pivot
            residual[j] -= share * off
            direction[j] -= share * slope
            covariance[j] = [one - share * other for one, other in zip(covariance[j], row, strict=True)]
    return Eliminated(chi2, log_det, pull, precision)


def hypotheses_of(
    observation: Observation,
    shortlist: Sequence[Landmark],
    pose_key: int,
    joint: KeyedCovariance,
    values: gtsam.Values,
    estimate: Estimate,
    change: FloatArray | None = None,
) -> list[Hypothesis]:
    """The observation's factor for each landmark of its shortlist, linearised at values.

    With a `change` these have the pose `elsewhere` than the estimate does.
    """
    blank, hypotheses = -float(np.log(observation.volume)) if shortlist else 0.0, []
    for landmark in shortlist:
        linear = observation_factor(observation, pose_key, landmark, estimate).linearize(values)
        jacobian, target = linear.jacobian()
        keys = list(linear.keys())
        columns, distance = joint.columns(keys), joint.columns([landmark.key])[-1]
        if change is not None and pose_key in keys:  # of a landmark that lives at the pose it is no variable
            target = target + jacobian[:, np.isin(columns, joint.columns([pose_key]))] @ change
        telling = np.abs(jacobian).max(axis=1) > 0.0  # a native line factor has an empty row: two dof, not three
        candidate = Candidate(landmark.id, 0.0, int(telling.sum()), blank, landmark.n_keyframes > 1)
        by_distance = jacobian[telling][:, columns == distance][:, 0]
        hypotheses.append(Hypothesis(candidate, columns, jacobian[telling], target[telling], by_distance))
    return hypotheses


def elsewhere(values: gtsam.Values, pose_key: int, change: FloatArray | None) -> gtsam.Values:
    """Values with a pose elsewhere by a tangent, shape (6,); None: the same values."""
    if change is None:
        return values
    moved = gtsam.Values(values)
    moved.update(pose_key, values.atPose3(pose_key).retract(change))
    return moved


def innovations_of(hypotheses: Sequence[Hypothesis], state: State) -> list[Innovation]:
    """The observation under each of its candidates, most likely first; equals in order of their birth."""
    found = [state.innovation(hypothesis) for hypothesis in hypotheses]
    return sorted(found, key=lambda one: (-one.candidate.log_likelihood, one.candidate.landmark))
