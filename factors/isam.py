"""iSAM2 on planes: parameters with which it gives what a batch gives, and covariances in the estimate's tangents."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.linalg import block_diag

from factors._check import as_keys, held, told_key
from spplanes._check import FloatArray, as_count, as_positive, check_instance


def isam2_parameters(*, threshold: float = 0.01) -> gtsam.ISAM2Params:
    """Parameters with which iSAM2 on planes gives what a batch gives, with `settle` after each update.

    GTSAM's own (relinearise at 0.1 rad or m, every tenth update) leave planes and poses linearised centimetres off, and
    its covariances know nothing of it. Here whatever moves by ``threshold`` (rad or m) is relinearised at once: a tilt
    e of a plane d away neglects d e^2 / 2 of its distance, half a millimetre at 10 m. Elimination is by QR: normal
    equations square a condition number that long corridors make large.
    ValueError: a threshold that is not positive.
    """
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.setRelinearizeThreshold(as_positive("threshold", threshold))
    parameters.relinearizeSkip = 1
    return parameters


def settle(isam: gtsam.ISAM2, *, most: int = 20) -> int:
    """Update until no variable is relinearised any more, or ``most`` times; returns the number of updates.

    One ``isam.update(graph, values)`` is one Gauss-Newton step: a new pose starts from where odometry put it, and one
    step from there is not the optimum.
    """
    check_instance("isam", isam, gtsam.ISAM2)
    for count in range(1, as_count("most", most) + 1):
        if not isam.update().getVariablesRelinearized():
            return count
    return most


def isam_covariance(isam: gtsam.ISAM2, values: gtsam.Values, keys: Sequence[int]) -> FloatArray:
    """Joint marginal covariance of several variables, in the order of ``keys``, each in its tangent at ``values``.

    iSAM2 gives marginals in the tangents of its *linearisation point*. For poses that is the same to first order. The
    tangent of an ``OrientedPlane3`` is along ``Unit3.basis()``, which jumps where components of the normal tie: at
    every floor and every axis-aligned wall the two may be turned by 90 deg, and a plane's sigmas change places.
    ``values`` is usually ``isam.calculateEstimate()``. The result is what `factors.world_plane_from_joint` takes for
    ``keys`` = (anchor, plane), and `factors.landmark_to_plane` for the landmark alone.

    ValueError: keys that are no integers, given twice, or not in ``isam`` and ``values``.
    """
    check_instance("isam", isam, gtsam.ISAM2)
    check_instance("values", values, gtsam.Values)
    names = as_keys("keys", keys)
    for key in names:
        if not (isam.valueExists(key) and values.exists(key)):
            raise ValueError(f"keys: expected variables of isam and of values, got {told_key(key)}")
    joint, turns = isam.jointMarginalCovariance(names), []
    for key in names:
        there, here = (held(some.atOrientedPlane3, key) for some in (isam.getLinearizationPoint(), values))
        no_plane = there is None or here is None
        turns.append(np.eye(len(joint.at(key, key))) if no_plane else tangent_turn(there, here))
    turn = block_diag(*turns)
    return turn @ joint.fullMatrix() @ turn.T


def tangent_turn(there: gtsam.OrientedPlane3, here: gtsam.OrientedPlane3) -> FloatArray:
    """Matrix (3, 3) that takes a tangent of a plane at one estimate to that at another: its basis jumps at ties."""
    turn = np.eye(3)
    turn[:2, :2] = here.normal().basis().T @ there.normal().basis()
    return turn
