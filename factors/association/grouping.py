"""Which measurements of one pose are one plane: pieces of a wall that start one landmark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri
from shapely.geometry.base import BaseGeometry

from factors.association.decisions import AssociationGates
from factors.association.observations import Observation
from spplanes.outlines.extents import grow
from spplanes.spmodel import inverse_transform


def group_planes(
    observations: Sequence[Observation], gates: AssociationGates, tilt_sigma_rad: float, may_start: Sequence[bool]
) -> list[list[int]]:
    """Gather measurements from one pose that are one plane; the first of each group is the largest.

    They share a pose, so the chi2 of two of them needs no state: it is that of two planes of one frame. The wall of a
    line may lean by `tilt_sigma_rad` from the normal of its scan plane. Whether each `may_start` a group is given;
    those that may not can join one.
    """
    limit = float(chdtri(3, gates.significance))
    planes = [observation.full_plane(tilt_sigma_rad) for observation in observations]
    sizes = [float(np.linalg.norm(np.ptp(one.vertices, axis=0))) for one in observations]  # of their corners' boxes
    order = sorted(range(len(observations)), key=lambda index: (-sizes[index], index))
    groups: list[list[int]] = []
    outlines: list[BaseGeometry] = []

    def patch(index: int, on: int) -> BaseGeometry:
        """What was seen of an observation, in (x, y) of the plane of another."""
        return observations[index].patch_in(inverse_transform(planes[on].frame))

    for index in order:
        apart = sorted((planes[group[0]].mahalanobis(planes[index]), number) for number, group in enumerate(groups))
        homes = (
            number
            for chi2, number in apart
            if chi2 <= limit and outlines[number].distance(patch(index, groups[number][0])) <= gates.gap_m
        )
        home = next(homes, None)
        if home is not None:
            outlines[home] = grow(outlines[home], patch(index, groups[home][0]))
            groups[home].append(index)
        elif may_start[index]:
            groups.append([index])
            outlines.append(patch(index, index))
    return groups
