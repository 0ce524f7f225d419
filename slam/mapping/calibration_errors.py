"""What the calibration of sensors leaves open is one unknown of the whole map: considered in every covariance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from factors.association.estimate import observation_factor
from factors.association.observations import PlaneObservation
from slam.backend.estimator import is_pose, pose_symbol
from slam.backend.joint_covariance import SharedUnknown
from slam.map.landmarks import Landmark, Sighting
from slam.map.state import EstimatorState
from spplanes import Plane
from spplanes._check import FloatArray

#: The key of the unknown, in the linear graph alone.
_KEY = gtsam.symbol("c", 1)
#: The effect of errors on a factor is the difference that so small a part of them makes, of a standard deviation.
_STEP = 1e-3


class CalibrationErrors:
    """What planes have of errors of their sensors' calibration (`calibration_effect`), an unknown that factors share.

    They are the same in every image, so they do not average out: ten thousand looks know a wall to a tenth of a
    millimetre, and a camera whose depths are long by 1 % has it 2 cm off. The graph goes on as it is. With c the
    errors, of unit covariance, the graph says what they are with the covariance C, all else eliminated; that mean is
    what poses and planes are not given: both are considered.
    """

    def __init__(self, state: EstimatorState) -> None:
        self._keyframes, self._landmarks, self._backend = state.keyframes, state.landmarks, state.backend

    def unknown(self) -> SharedUnknown | None:
        """All such errors of all sensors, as the graph has them; None: no plane has any."""
        seen = [(landmark, one) for landmark in self._landmarks for one in landmark.sightings if one.sensor is not None]
        if not seen:
            return None
        looks = list(self._looks(sorted(seen, key=lambda one: one[1].keyframe)))
        widths: dict[str, int] = {}
        for look in looks:
            widths[look.observation.sensor] = max(widths.get(look.observation.sensor, 0), look.effect.shape[1])
        firsts = dict(zip(widths, np.cumsum([0, *widths.values()]).tolist(), strict=False))
        count = sum(widths.values())
        instead = {
            look.sighting.factor_index: self._with_errors(look, firsts[look.observation.sensor], count)
            for look in looks
        }
        graph = self._backend.with_shared(_KEY, instead)
        mean, covariance = graph.posterior(np.eye(count))
        return graph.known(covariance + np.outer(mean, mean))

    def _looks(self, seen: Sequence[tuple[Landmark, Sighting]]) -> Iterator[_Look]:
        """What was seen, by keyframe: each is read once."""
        at, observations = -1, ()
        for landmark, sighting in seen:
            if at != sighting.keyframe:
                at, observations = sighting.keyframe, self._keyframes[sighting.keyframe].observations
            observation = observations[sighting.observation]
            assert isinstance(observation, PlaneObservation) and observation.calibration_effect is not None
            yield _Look(landmark, sighting, observation, observation.calibration_effect)

    def _with_errors(self, look: _Look, first: int, count: int) -> gtsam.GaussianFactor:
        """A plane's factor, linearised, with so many errors an unknown, of which those from the `first` are its own."""
        seen, pose_key = look.observation, pose_symbol(look.sighting.keyframe)

        def linear(plane: Plane) -> gtsam.JacobianFactor:
            measured = replace(seen, plane=plane)
            factor = observation_factor(measured, pose_key, look.landmark, self._backend, look.sighting.robust)
            return factor.linearize(self._backend.values_of(factor.keys()))

        as_seen = linear(seen.plane)
        jacobian, target = as_seen.jacobian()
        columns = np.zeros((len(target), count))
        for number, effect in enumerate(look.effect.T, start=first):
            moved = replace(seen.plane, frame=seen.plane.location.perturbed(_STEP * effect).transform)
            columns[:, number] = (linear(moved).jacobian()[1] - target) / _STEP
        return _joined(list(as_seen.keys()), jacobian, columns, target)


class _Look(NamedTuple):
    """One observation of a landmark by a sensor whose calibration is open."""

    landmark: Landmark
    sighting: Sighting
    observation: PlaneObservation
    effect: FloatArray
    """Of the errors of its calibration, shape (3, K)."""


def _joined(keys: Sequence[int], jacobian: FloatArray, columns: FloatArray, target: FloatArray) -> gtsam.GaussianFactor:
    """A linear factor with one more variable: GTSAM's own takes three from Python, this one has up to four."""
    ends = np.cumsum([6 if is_pose(key) else 3 for key in keys])
    blocks = [*np.split(jacobian, ends[:-1], axis=1), columns]

    def error(_: gtsam.CustomFactor, __: gtsam.Values, jacobians: gtsam.JacobianVector | None) -> FloatArray:
        if jacobians is not None:
            for number, block in enumerate(blocks):
                jacobians[number] = np.asfortranarray(block)
        return -target

    unit = gtsam.noiseModel.Unit.Create(len(target))
    return gtsam.CustomFactor(unit, [*keys, _KEY], error).linearize(gtsam.Values())
