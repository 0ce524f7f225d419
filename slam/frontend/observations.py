"""What one keyframe saw: observations of `factors`, and the error of walls that are not straight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from factors.association.observations import LineObservation, Observation, PlaneObservation
from spplanes import Plane

__all__ = ["LineObservation", "Observation", "PlaneObservation", "on_real_wall", "planes_of"]


def on_real_wall(seen: LineObservation, sigma_m: float, correlation_m: float) -> LineObservation:
    """The line with the error of a wall that is not straight, which the beams of one patch of it share.

    Of the L / correlation patches of a line each is off by `sigma_m`: its middle by sigma^2 / patches, its direction by
    12 / L^2 times that. What the line's covariance already holds of it, as if every beam were off by itself, is less.
    """
    line = seen.line
    patches = max(line.length / correlation_m, 1.0)
    shift = sigma_m**2 * max(1.0 / patches - 1.0 / seen.n_points, 0.0)
    if shift == 0.0 or line.length == 0.0:
        return seen
    middle = float(line.endpoints.mean(axis=0) @ line.direction)
    jacobian = np.array(((1.0, 0.0), (middle, 1.0)))
    extra = jacobian @ np.diag((12.0 * shift / line.length**2, shift)) @ jacobian.T
    return replace(seen, line=replace(line, covariance=line.covariance + extra))


def planes_of(observations: Sequence[Observation]) -> list[Plane]:
    """Those that are planes, in the body frame, in their order."""
    return [observation.plane for observation in observations if isinstance(observation, PlaneObservation)]
