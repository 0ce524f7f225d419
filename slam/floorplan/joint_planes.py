"""The planes of a map with the joint covariance of all of them: what lengths and areas are computed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend
from slam.floorplan.quantities import Gradient, Quantity
from slam.map.landmarks import LandmarkMap
from slam.map.map_planes import MapPlane
from slam.mapping.same_plane import hesse_of
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class JointPlanes:
    """Planes n.x = d of one world, and how their errors hang together."""

    planes: tuple[MapPlane, ...]
    """The planes with what was seen of them; elsewhere each goes by its index here."""
    hesse: FloatArray
    """Rows (normal, d), shape (P, 4), the normal toward the side it was seen from."""
    covariance: FloatArray
    """Of all rows of `hesse` stacked, shape (4 P, 4 P); singular, for every normal keeps its length."""

    def quantity(self, value: float, gradient: Gradient) -> Quantity:
        """A number that depends on planes, with its standard deviation to first order."""
        row = self._row(gradient)
        return Quantity(value, float(np.sqrt(max(row @ self.covariance @ row, 0.0))), gradient)

    def covariance_of(self, quantities: Sequence[Quantity]) -> FloatArray:
        """Joint covariance (Q, Q) of several quantities, to first order."""
        jacobian = np.array([self._row(one.gradient) for one in quantities]).reshape(-1, self.hesse.size)
        return jacobian @ self.covariance @ jacobian.T

    def _row(self, gradient: Gradient) -> FloatArray:
        row = np.zeros(self.hesse.shape)
        for plane, derivative in gradient.items():
            row[plane] += derivative
        return row.ravel()


def joint_planes(planes: Sequence[MapPlane], landmarks: LandmarkMap, backend: Backend) -> JointPlanes:
    """The planes of a map in the world, with the joint marginal of their landmarks and anchor poses.

    Args:
        planes: of the map, as `PlaneSlam.planes` gives them.
        landmarks, backend: the state they were read from.
    """
    known = [hesse_of(landmarks[one.id], backend) for one in planes]
    keys = list(dict.fromkeys(key for _, _, _, by in known for key in by))
    if not keys:
        return JointPlanes((), np.empty((0, 4)), np.empty((0, 0)))
    joint = backend.read_joint_covariance(keys)
    jacobian = np.zeros((4 * len(known), len(joint.full)))
    for row, (_, _, block, by) in enumerate(known):
        jacobian[4 * row : 4 * row + 4, joint.columns(by)] = block
    covariance = jacobian @ joint.full @ jacobian.T
    hesse = np.array([[*normal, d] for normal, d, _, _ in known])
    return JointPlanes(tuple(planes), hesse, 0.5 * (covariance + covariance.T))
