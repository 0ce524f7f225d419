"""Ties: two landmarks of two missions that are one plane, as a factor over both, their anchors and the missions' bases.

Every mission keeps its own frame; where that is in the common one is a variable, the mission's base.

References:
    Kim, Kaess, Fletcher, Leonard, Bachrach, Roy, Teller, "Multiple relative pose graphs for robust cooperative
    mapping", ICRA 2010, for the bases ("anchor nodes").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from slam.mapping.same_plane import anchored_difference
from spplanes._check import FloatArray

#: A plane is itself: what two landmarks that are one may differ by, rad and m. As far below what is measured as the
#: prior of a map is (`slam.session.prior_map`), and no further, for the root of the information is solved by QR.
_SAME = 1e-6
#: Keys of the missions of one graph are this far apart.
_APART = 1 << 40


@dataclass(frozen=True, order=True)
class Place:
    """A landmark of a mission."""

    mission: int
    """Number of the mission."""
    landmark: int
    """The landmark's id in it."""


@dataclass(frozen=True, order=True)
class Tie:
    """Two landmarks of two missions that are one plane."""

    first: Place
    """One of them."""
    second: Place
    """The other."""

    @property
    def missions(self) -> tuple[int, int]:
        """Whose they are, ascending."""
        return min(self.first.mission, self.second.mission), max(self.first.mission, self.second.mission)


def joint_key(mission: int, key: int) -> int:
    """A key of a mission in a graph of many."""
    return key + (mission + 1) * _APART


def base_key(mission: int) -> int:
    """Key of common_T_mission."""
    return gtsam.symbol("b", mission)


@dataclass(frozen=True)
class TiedKeys:
    """Keys of one side of a tie in the graph of many missions."""

    base: int
    """Of the mission's base."""
    anchor: int
    """Of the landmark's anchor."""
    plane: int
    """Of the landmark."""


def tie_factor(first: TiedKeys, second: TiedKeys) -> gtsam.CustomFactor:
    """The factor of a tie: the difference of the planes in the frame of the second one's anchor is nothing."""
    keys = [first.base, first.anchor, first.plane, second.base, second.anchor, second.plane]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        difference, blocks = tied_difference(values, first, second)
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block)
        return difference

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, _SAME), keys, error)


def tied_difference(
    values: gtsam.Values, first: TiedKeys, second: TiedKeys
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """How two landmarks of two missions differ, (3,), and the derivatives by the keys of the first, then the second."""
    planes, anchors, adjoints = [], [], []
    for side in (first, second):
        anchor = values.atPose3(side.anchor)
        planes.append(values.atOrientedPlane3(side.plane))
        anchors.append(values.atPose3(side.base).compose(anchor).matrix())
        adjoints.append(anchor.inverse().AdjointMap())
    difference, (by_first, by_a, by_second, by_b) = anchored_difference(planes[0], anchors[0], planes[1], anchors[1])
    return difference, (by_a @ adjoints[0], by_a, by_first, by_b @ adjoints[1], by_b, by_second)
