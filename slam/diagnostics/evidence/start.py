"""Evidence: the start in a prior map, as somebody stated it, against where the map's planes put it."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from scipy.special import chdtrc

from factors._conventions import POSE3_TO_SP
from slam.backend.estimator import BackendError, pose_symbol
from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.verdict import Evidence, named
from slam.geometry.frames import inverse
from spplanes._check import FloatArray

#: The map says something of a direction where it takes away this share of the variance that was stated: half leaves
#: as much to the map as to whoever stated it.
_TOLD = 0.5


def start_evidence(run: Finished) -> Iterator[Evidence]:
    """A start that is further from the estimate than its covariance allows.

    Estimate x and start s, of covariances P and S: x - s has the covariance S - P, for x holds s as a measurement. A
    chi2 test of that in the directions in which the map says more than the start did. Where the first keyframe is no
    longer in the graph, or nothing was said, there is no test.
    """
    if run.prior is None or not len(run.trajectory):
        return
    try:
        covariance = run.backend.read_covariance(pose_symbol(0))[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    except (BackendError, KeyError, ValueError, RuntimeError):
        return
    chi2, dof, error = start_innovation(
        run.prior.world_T_start, run.prior.start_covariance, run.trajectory.poses[0], covariance
    )
    if not dof:
        return
    far, turned = float(np.linalg.norm(error[:3])), float(np.rad2deg(np.linalg.norm(error[3:])))
    yield Evidence(
        "start",
        "doubtful",
        float(chdtrc(dof, chi2)),
        far,
        "m",
        (0,),
        f"at {named((0,))} the map's planes put the start {far:.2f} m and {turned:.1f} deg from where it was stated, "
        f"{np.sqrt(chi2 / dof):.1f} times what was stated of its errors",
    )


def start_innovation(
    world_T_start: FloatArray, stated: FloatArray, estimate: FloatArray, covariance: FloatArray
) -> tuple[float, int, FloatArray]:
    """Chi2, its degrees of freedom, and the difference (6,) of an estimated first pose from the stated one.

    Args:
        world_T_start: as stated, shape (4, 4).
        stated: its covariance in the SP order (x, y, z, phi, theta, psi), composed on the right, shape (6, 6).
        estimate: with the statement among its measurements, shape (4, 4).
        covariance: of that, in the same order, shape (6, 6).
    """
    error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(world_T_start) @ estimate))[POSE3_TO_SP]
    root = np.linalg.cholesky(stated)
    left = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    shares, directions = np.linalg.eigh(np.eye(6) - 0.5 * (left + left.T))
    told = shares > _TOLD
    seen = directions[:, told].T @ np.linalg.solve(root, error)
    return float(np.sum(seen**2 / shares[told])), int(told.sum()), error
