"""Which overlaps of missions agree with one another round every loop, and the components that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam.geometry.frames import inverse
from slam.joining.overlap import Comparison
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Motion:
    """An uncertain motion between two missions' frames."""

    a_T_b: FloatArray
    """Shape (4, 4)."""
    covariance: FloatArray
    """Of its tangent on the right, shape (6, 6)."""

    def __matmul__(self, after: Motion) -> Motion:
        """This motion and another one after it, independent of it; covariance to first order."""
        adjoint = gtsam.Pose3(inverse(after.a_T_b)).AdjointMap()
        spread = adjoint @ self.covariance @ adjoint.T + after.covariance
        return Motion(self.a_T_b @ after.a_T_b, spread)

    def turned_round(self) -> Motion:
        """The motion the other way."""
        adjoint = gtsam.Pose3(self.a_T_b).AdjointMap()
        return Motion(inverse(self.a_T_b), adjoint @ self.covariance @ adjoint.T)

    def chi2(self, other: Motion) -> float:
        """Squared Mahalanobis distance to another one of the same frames, independent of it; 6 dof."""
        error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(self.a_T_b) @ other.a_T_b))
        return float(error @ np.linalg.solve(self.covariance + other.covariance, error))


@dataclass(frozen=True, eq=False)
class Component:
    """Missions that overlap, directly or by others."""

    missions: tuple[str, ...]
    """Names; the first one's frame is the common one."""
    common_T_mission: dict[str, FloatArray]
    """About where the frame of each is, (4, 4)."""
    overlaps: tuple[Comparison, ...]
    """What joins them."""


def consistent(comparisons: Sequence[Comparison], significance: float) -> list[Comparison]:
    """The comparisons, those taken back ("revoked") that contradict others round a loop.

    Overlaps are taken in the order of their evidence. One that closes a loop over those before it must agree with the
    way round (chi2, 6 dof), else it is taken back: of a loop that does not close it is the weakest.

    Args:
        comparisons: of pairs of missions.
        significance: share of true loops that are taken for contradictions. Motions of one loop share the errors of the
            missions' maps, so it should be small.

    References:
        Mangelson et al., "Pairwise Consistent Measurement Set Maximization", ICRA 2018, for consistency round loops.
    """
    limit = float(chi2_distribution.isf(significance, 6))
    known: dict[str, dict[str, Motion]] = {}
    verdicts: dict[int, Comparison] = {}
    joined = [k for k, one in enumerate(comparisons) if one.verdict == "joined" and one.alignment is not None]
    for index in sorted(joined, key=lambda k: (-comparisons[k].strength, k)):
        one = comparisons[index]
        assert one.alignment is not None
        motion = Motion(one.alignment.a_T_b, one.alignment.covariance)
        way = _way(known, one.first, one.second)
        if way is None:
            known.setdefault(one.first, {})[one.second] = motion
            known.setdefault(one.second, {})[one.first] = motion.turned_round()
        elif (chi2 := motion.chi2(way)) > limit:
            reason = f"it contradicts the way over other missions (chi2 {chi2:.0f} of 6 dof)"
            verdicts[index] = replace(one, verdict="revoked", reason=reason)
    return [verdicts.get(k, one) for k, one in enumerate(comparisons)]


def components_of(names: Sequence[str], comparisons: Sequence[Comparison]) -> list[Component]:
    """Missions in components, the largest first, in the order of their names given; those alone are one each."""
    joined = [one for one in comparisons if one.verdict == "joined" and one.alignment is not None]
    motions: dict[str, list[tuple[str, FloatArray]]] = {name: [] for name in names}
    for one in sorted(joined, key=lambda one: -one.strength):
        assert one.alignment is not None
        motions[one.first].append((one.second, one.alignment.a_T_b))
        motions[one.second].append((one.first, inverse(one.alignment.a_T_b)))
    left, found = list(names), []
    while left:
        placed, waiting = {left[0]: np.eye(4)}, [left[0]]
        while waiting:
            here = waiting.pop(0)
            for there, here_T_there in motions[here]:
                if there not in placed:
                    placed[there] = placed[here] @ here_T_there
                    waiting.append(there)
        members = tuple(name for name in names if name in placed)
        overlaps = tuple(one for one in joined if one.first in placed)
        found.append(Component(members, {name: placed[name] for name in members}, overlaps))
        left = [name for name in left if name not in placed]
    return sorted(found, key=lambda one: -len(one.missions))


def _way(known: dict[str, dict[str, Motion]], start: str, end: str) -> Motion | None:
    """The motion over the overlaps known, which are a forest; None where they do not lead there."""
    reached: dict[str, Motion] = {start: Motion(np.eye(4), np.zeros((6, 6)))}
    waiting = [start]
    while waiting:
        here = waiting.pop(0)
        for there, motion in known.get(here, {}).items():
            if there not in reached:
                reached[there] = reached[here] @ motion
                waiting.append(there)
    return reached.get(end)
