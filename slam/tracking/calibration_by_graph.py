"""The wheels' errors of calibration by all that the graph knows: they are one unknown of the whole way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.special import expit

from slam.backend.estimator import Backend, BackendError, pose_symbol
from slam.backend.joint_covariance import SharedUnknown
from slam.frontend.odometry import Motion
from slam.frontend.wheel_calibration import (
    WheelCalibration,
    random_covariance,
    response_as_moved,
    unknown_at_first,
)
from slam.geometry.frames import inverse
from slam.map.sparsification import MeasuredStep, Sparsifier
from spplanes._check import FloatArray

#: The key of the unknown, in the linear graph alone.
_KEY = gtsam.symbol("c", 0)
#: Steps before it is first asked for, and by how many times more before it is asked for again.
_FIRST, _GROWTH = 4, 1.1


class FoundCalibration(NamedTuple):
    """Scale and curvature of the odometry as the graph has them."""

    mean: FloatArray
    """Shape (2,), 1 and rad/m; of both cases, that there are none and that there are some."""
    covariance: FloatArray
    """The same, shape (2, 2)."""
    as_stated: float
    """Probability that there are none, as the rig says."""


class CalibrationByGraph:
    """Asks the graph every so often, and lets all steps so far have the answer.

    Errors of calibration are the same in every step: small in each, they add up, and what tells them may come long
    after the steps that suffered from them. With c the errors, a step's residual is r - G c. All other unknowns of the
    linearised graph are eliminated, which leaves information L and vector l on c: exact but for the linearisation, and
    all correlations with it. A rig that states no errors of calibration is right with probability one half, or they
    have the prior of wheels that nobody describes, S:
    p(graph | c ~ S) / p(graph | c = 0) = |I + S L|^-1/2 exp(l^T (L + S^-1)^-1 l / 2).
    Once there are more likely some than none, all steps have their mean over both cases, and what is still open about
    them is in every covariance that is read (`SharedUnknown`); where nothing tells, the rig is believed. Where a rig
    states them, there are some; until the graph is asked first each step is as wide as they make it, and they are
    learnt on the way (`WheelCalibration`).

    G is by the way that the graph has (`response_as_moved`): what is solved for is t = s / (1 + s) of a scale s.

    References:
        Martinelli, Tomatis, Siegwart, "Simultaneous localization and odometry self calibration", Auton. Robots 2007,
        for the errors as part of the state.
    """

    def __init__(self, sparsifier: Sparsifier, backend: Backend, calibration: WheelCalibration) -> None:
        self._sparsifier, self._backend, self._calibration = sparsifier, backend, calibration
        self._next = _FIRST
        backend.share(self._unknown)

    def learn(self) -> float | None:
        """Ask, if it is time; by how much poses moved at most, m, for all steps have other factors; None: none has."""
        if self._sparsifier.n_measured < self._next:
            return None
        self._next = int(np.ceil(_GROWTH * self._sparsifier.n_measured))
        steps = self._sparsifier.measured_steps()
        if not steps:
            return None
        try:
            found, _ = calibration_by_graph(steps, self._backend)
        except BackendError:  # the graph cannot be asked now; nothing was changed
            return None
        if not self._calibration.shared and found.as_stated >= 0.5:
            return None
        self._calibration.share(found.mean, found.covariance)
        factors = [_factor(step, self._calibration.corrected(step.motion)) for step in steps]
        ends = [pose_symbol(step.keyframe) for step in steps]
        before = self._backend.poses(ends)[:, :3, 3]
        indices = self._backend.exchange(factors, [step.factor_index for step in steps], ())
        self._sparsifier.relinked(steps, indices)
        self._backend.settle(rounds=5)
        return float(np.linalg.norm(self._backend.poses(ends)[:, :3, 3] - before, axis=1).max())

    def _unknown(self) -> SharedUnknown | None:
        """The errors of calibration, once they were found: by how much what all steps have may be wrong."""
        if not self._calibration.shared:
            return None
        steps = self._sparsifier.measured_steps()
        if not steps:
            return None
        found, graph = calibration_by_graph(steps, self._backend)
        since = found.mean - self._calibration.mean  # what was seen since the steps were put in says otherwise
        return graph.known(found.covariance + np.outer(since, since))


def calibration_by_graph(steps: Sequence[MeasuredStep], backend: Backend) -> tuple[FoundCalibration, SharedUnknown]:
    """The errors of calibration in steps that are in the graph, and the graph as it depends on them.

    Raises:
        BackendError: the graph became indeterminate.
    """
    graph = backend.with_shared(_KEY, {step.factor_index: _with_calibration(step, backend) for step in steps})
    prior = unknown_at_first(steps[0].motion)  # of which one error may be known to be none
    mean, covariance = graph.posterior(prior)
    log_odds = 0.5 * float(graph.vector @ mean - np.linalg.slogdet(np.eye(2) + prior @ graph.information)[1])
    some = 1.0 if np.any(steps[0].motion.calibration_sigmas) else float(expit(log_odds))
    covariance = some * (0.5 * (covariance + covariance.T) + (1.0 - some) * np.outer(mean, mean))
    found = some * mean
    found[0] += found[0] ** 2  # a share of the way driven, to one of the way measured: t / (1 - t)
    return FoundCalibration(found, covariance, 1.0 - some), graph


def _factor(step: MeasuredStep, motion: Motion) -> gtsam.NonlinearFactor:
    return motion.factor(pose_symbol(step.before), pose_symbol(step.keyframe))


def _with_calibration(step: MeasuredStep, backend: Backend) -> gtsam.GaussianFactor:
    """The step as measured, linearised, its errors of calibration an unknown.

    With them the measured motion is another by G c, x and y along the axes of its start, and the error less by that, in
    the tangent of its end.
    """
    keys = pose_symbol(step.before), pose_symbol(step.keyframe)
    motion = replace(step.motion, covariance=random_covariance(step.motion))
    response = response_as_moved(motion, inverse(backend.pose(keys[0])) @ backend.pose(keys[1]))
    linear = _factor(step, motion).linearize(backend.values_of(keys))
    jacobian, target = linear.jacobian()
    first, second = jacobian[:, :6], jacobian[:, 6:]
    if next(iter(linear.keys())) != keys[0]:
        first, second = second, first
    b_R_a = motion.a_T_b[:3, :3].T
    moved = np.zeros((6, 2))
    moved[:3], moved[3:] = np.outer(b_R_a[:, 2], response[2]), b_R_a[:, :2] @ response[:2]
    unit = gtsam.noiseModel.Unit.Create(len(target))
    return gtsam.JacobianFactor(keys[0], first, keys[1], second, _KEY, -second @ moved, target, unit)
