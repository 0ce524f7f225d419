"""Which overlaps of missions agree with one another round every loop, and the components that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.geometry.frames import inverse
from slam.joining.overlap import Comparison
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Motion:
    """An uncertain motion between two missions' frames, (4, 4)."""

    a_T_b: FloatArray
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
    limit = float(chdtri(6, significance))
    known: dict[str, dict[str, Motion]] = {}
    told = list(comparisons)
    for index, motion in _joined(comparisons):
        one = comparisons[index]
        way = _reached(known, one.first).get(one.second)
        if way is None:
            _link(known, one, motion)
        elif (chi2 := motion.chi2(way)) > limit:
            reason = f"it contradicts the way over other missions (chi2 {chi2:.0f} of 6 dof)"
            told[index] = replace(one, verdict="revoked", reason=reason)
    return told


def components_of(names: Sequence[str], comparisons: Sequence[Comparison]) -> list[Component]:
    """Missions in components, the largest first, in the order of their names given; those alone are one each."""
    joined = _joined(comparisons)
    known: dict[str, dict[str, Motion]] = {}
    for index, motion in joined:
        _link(known, comparisons[index], motion)
    overlaps = [comparisons[index] for index in sorted(index for index, _ in joined)]
    left, found = list(names), []
    while left:
        placed = _reached(known, left[0])
        members = {name: placed[name].a_T_b for name in names if name in placed}
        found.append(
            Component(tuple(members), members, tuple(overlap for overlap in overlaps if overlap.first in placed))
        )
        left = [name for name in left if name not in placed]
    return sorted(found, key=lambda one: -len(one.missions))


def _joined(comparisons: Sequence[Comparison]) -> list[tuple[int, Motion]]:
    """Places of the overlaps among comparisons, the strongest first, and the motion of each."""
    found = [
        (index, Motion(comparison.alignment.a_T_b, comparison.alignment.covariance))
        for index, comparison in enumerate(comparisons)
        if comparison.verdict == "joined" and comparison.alignment is not None
    ]
    return sorted(found, key=lambda pair: -comparisons[pair[0]].strength)


def _link(known: dict[str, dict[str, Motion]], one: Comparison, motion: Motion) -> None:
    known.setdefault(one.first, {})[one.second] = motion
    known.setdefault(one.second, {})[one.first] = motion.turned_round()


def _reached(known: dict[str, dict[str, Motion]], start: str) -> dict[str, Motion]:
    """The motions from one mission to all that overlaps lead to, over the fewest of them."""
    reached, waiting = {start: Motion(np.eye(4), np.zeros((6, 6)))}, [start]
    for here in waiting:
        for there, motion in known.get(here, {}).items():
            if there not in reached:
                reached[there] = reached[here] @ motion
                waiting.append(there)
    return reached
