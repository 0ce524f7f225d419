"""Two clouds of a lidar that moved while it turned: where they lie to each other when how it moved is unknown.

Of two clouds nobody knows a motion; that there was one shows where what lies in different directions does not fit
together. The pose of one in the other is looked for with both motions beside it, each even and slow by a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.frontend.scan_surfaces import moved_on
from slam.registration.surface_registration import Correspondences, LocalMap, Residuals
from slam.registration.visibility import Scan
from slam.sensors.rig import Sensor
from slam.tracking.turns import timed
from spplanes._check import FloatArray
from spplanes.clouds.turn import TurnBegin

#: How far bodies move and turn in a turn of a lidar: standard deviations, rad and m.
_PRIOR = np.diag(np.tile(np.repeat([0.1, 0.1], 3), 2) ** -2.0)
#: Clouds of one moment look bent by chance this often; rounds of a descent, and what ends it, rad and m.
_SIGNIFICANCE, _ROUNDS, _CONVERGED = 1e-4, 12, 1e-5
#: How far, in widths, partners are looked for at first, and in the last rounds.
_REACH, _LAST_REACH = 1.5, 1.0
#: Column of elements with the share of the turn at which each was seen, from its middle on.
_SHARE = 9


class BentCloud(NamedTuple):
    """What a lidar saw in a turn, and where that began."""

    elements: FloatArray
    """Surface elements in the body frame, shape (N, 9)."""
    sensor: Sensor
    begin: TurnBegin

    @property
    def timed(self) -> FloatArray:
        """Those on surfaces, with the share of the turn at which each was seen, from its middle on, shape (N, 10)."""
        own, shares = timed(self.elements, self.sensor, self.begin)
        return np.column_stack((own, shares - 0.5))


class Straightened(NamedTuple):
    """The pose of a bent cloud in another one, each as of the middle of its turn."""

    a_T_b: FloatArray
    """Shape (4, 4)."""
    covariance: FloatArray
    """Of its tangent on the right, GTSAM order, motions unknown, shape (6, 6)."""


def straightened(a: BentCloud, b: BentCloud, a_T_b: FloatArray) -> Straightened | None:
    """The pose (4, 4) of cloud B in cloud A again, with how the body moved in both turns; None: nothing shows that."""
    known, seen, pose, motions = a.timed, b.timed, a_T_b, np.zeros(12)
    if min(len(known), len(seen)) < len(motions):
        return None
    information = np.eye(18)
    for round_ in range(_ROUNDS):
        local = LocalMap([(np.eye(4), Scan(moved_on(known, known[:, _SHARE], motions[:6]), np.zeros(3)))])
        own = moved_on(seen, seen[:, _SHARE], motions[6:])
        pairs = Correspondences(own, local)
        reach = _REACH if round_ < _ROUNDS // 2 else _LAST_REACH
        found = Residuals.of(pairs, pose, reach * pairs.widths)
        mine, theirs = own[found.index], local.elements[found.partners]
        normals = theirs[:, 3:6]
        by_motions = -_by_twist(theirs, normals), _by_twist(mine, normals @ pose[:3, :3])
        design = np.column_stack((found.jacobian, *by_motions))
        weighed = found.weights[:, None] * design
        information, told = design.T @ weighed, -weighed.T @ found.off
        if not round_ and not _is_bent(information, told):
            return None
        information[6:, 6:] += _PRIOR
        step = np.linalg.solve(information, told - np.concatenate((np.zeros(6), _PRIOR @ motions)))
        pose, motions = pose @ gtsam.Pose3.Expmap(step[:6]).matrix(), motions + step[6:]
        if np.abs(step).max() < _CONVERGED:
            break
    return Straightened(pose, np.asarray(np.linalg.inv(information)[:6, :6], dtype=np.float64))


def _is_bent(information: FloatArray, told: FloatArray) -> bool:
    """Whether residuals refuse clouds of one moment, wherever these lie: by what motions take away of their chi2."""
    by_pose = np.linalg.solve(information[:6, :6] + 1e-9 * np.eye(6), np.column_stack((information[:6, 6:], told[:6])))
    left = information[6:, 6:] - information[6:, :6] @ by_pose[:, :12] + _PRIOR
    score = told[6:] - information[6:, :6] @ by_pose[:, 12]
    return bool(score @ np.linalg.solve(left, score) > chdtri(12, _SIGNIFICANCE))


def _by_twist(elements: FloatArray, directions: FloatArray) -> FloatArray:
    """How much elements (N, 10) move along directions (N, 3) with a twist, shape (N, 6)."""
    return elements[:, _SHARE, None] * np.column_stack((np.cross(elements[:, :3], directions), directions))
