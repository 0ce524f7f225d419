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


class CameraErrors:
    """Lets covariances that are read hold what planes have of errors of calibration (`calibration_effect`).

    They are the same in every image, so they do not average out: ten thousand looks know a wall to a tenth of a
    millimetre, and a camera whose depths are long by 1 % has it 2 cm off. The graph goes on as it is. With c the
    errors, of unit covariance, and G what they do to the residuals of all planes, the graph says of c the information L
    and vector l, all else eliminated; what is left of them is C = (I + L)^-1, and C l is what poses and planes are not
    given: both are considered.
    """

    def __init__(self, state: EstimatorState) -> None:
        self._keyframes, self._landmarks, self._backend = state.keyframes, state.landmarks, state.backend
        self._backend.share(self._unknown)

    def _unknown(self) -> SharedUnknown | None:
        """All such errors of all sensors; None: no plane has any."""
        seen = [(landmark, one) for landmark in self._landmarks for one in landmark.sightings if one.sensor]
        if not seen:
            return None
        looks = list(self._looks(sorted(seen, key=lambda one: one[1].keyframe)))
        widths = {one.observation.sensor: one.effect.shape[1] for one in looks}
        ends = dict(zip(widths, np.cumsum(list(widths.values())).tolist(), strict=True))
        instead = {}
        for look in looks:
            end = ends[look.observation.sensor]
            columns = slice(end - widths[look.observation.sensor], end)
            instead[look.sighting.factor_index] = self._with_errors(look, columns, max(ends.values()))
        graph = self._backend.with_shared(_KEY, instead)
        left = np.linalg.inv(np.eye(len(graph.vector)) + graph.information)
        found = left @ graph.vector
        return graph.known(left + np.outer(found, found))

    def _looks(self, seen: Sequence[tuple[Landmark, Sighting]]) -> Iterator[_Look]:
        """What was seen, by keyframe: each is read once."""
        at, observations = -1, ()
        for landmark, sighting in seen:
            if at != sighting.keyframe:
                at, observations = sighting.keyframe, self._keyframes[sighting.keyframe].observations
            observation = observations[sighting.observation]
            assert isinstance(observation, PlaneObservation) and observation.calibration_effect is not None
            yield _Look(landmark, sighting, observation, observation.calibration_effect)

    def _with_errors(self, look: _Look, columns: slice, count: int) -> gtsam.GaussianFactor:
        """A plane's factor, linearised, with so many errors an unknown, of which some are its sensor's."""
        seen, pose_key = look.observation, pose_symbol(look.sighting.keyframe)

        def linear(observation: PlaneObservation) -> gtsam.JacobianFactor:
            factor = observation_factor(observation, pose_key, look.landmark, self._backend, look.sighting.robust)
            return factor.linearize(self._backend.values_of(factor.keys()))

        as_seen, effects = linear(seen), []
        jacobian, target = as_seen.jacobian()
        for effect in look.effect.T:
            other = linear(replace(seen, plane=_moved(seen.plane, _STEP * effect)))
            effects.append((other.jacobian()[1] - target) / _STEP)
        all_effects = np.zeros((len(target), count))
        all_effects[:, columns] = np.stack(effects, axis=1)
        return _joined(list(as_seen.keys()), jacobian, all_effects, target)


class _Look(NamedTuple):
    """One observation of a landmark by a sensor whose calibration is open."""

    landmark: Landmark
    sighting: Sighting
    observation: PlaneObservation
    effect: FloatArray
    """Of the errors of its calibration, shape (3, K)."""


def _moved(plane: Plane, perturbation: FloatArray) -> Plane:
    frame = plane.location.perturbed(perturbation).transform
    return Plane(frame, plane.covariance, plane.n_points, plane.outline, plane.chi2)


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
