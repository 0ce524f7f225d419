"""The information that an observation of a known plane gives on the pose it was seen from."""

from __future__ import annotations

import numpy as np

from slam.frontend.observations import LineObservation, Observation
from spplanes._check import FloatArray
from spplanes.spmodel import skew


def plane_information(observation: Observation) -> FloatArray:
    """Information (6, 6) that seeing a known plane gives on the pose, tangent (rx, ry, rz, x, y, z) of the body.

    A pose moved by (w, t) on the body's side sees the plane's normal n turned by n x w and the plane, at its centre c,
    moved along n by -n.t - w.(c x n); SP: theta = x.dn, psi = -y.dn. A line says nothing on the tilt about itself.
    """
    plane = observation.full_plane(1.0)
    x_axis, y_axis, normal = plane.frame[:3, :3].T
    jacobian = np.zeros((3, 6))
    jacobian[0, :3], jacobian[0, 3:] = skew(normal) @ plane.centre, -normal
    jacobian[1, :3] = -y_axis  # x cross n
    jacobian[2, :3] = -x_axis  # n cross y
    told = 2 if isinstance(observation, LineObservation) else 3
    return jacobian[:told].T @ np.linalg.solve(plane.covariance[:told, :told], jacobian[:told])
