"""Which measurements of one pose are one plane: pieces of a wall that start one landmark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri
from shapely.geometry.base import BaseGeometry

from factors.association.decisions import AssociationGates
from factors.association.observations import Observation
from spplanes import Plane
from spplanes.outlines.extents import grow
from spplanes.spmodel import inverse_transform


def group_planes(
    observations: Sequence[Observation], gates: AssociationGates, tilt_sigma_rad: float, may_start: Sequence[bool]
) -> list[list[int]]:
    """Gather measurements from one pose that are one plane; the first of each group is the largest.

    They share a pose, so the chi2 of two of them needs no state: it is that of two planes of one frame.

    Args:
        observations: all from one pose.
        gates: significance and gap within which two are one.
        tilt_sigma_rad: how far the wall of a line may lean from the normal of its scan plane, rad.
        may_start: of each observation: whether it makes a group; those that do not may join one.

    Returns:
        Groups of indices into `observations`, in order of their first member.
    """
    limit = float(chdtri(3, gates.significance))
    planes = [observation.full_plane(tilt_sigma_rad) for observation in observations]
    order = sorted(range(len(observations)), key=lambda index: (-_patch_size(observations[index]), index))
    groups: list[list[int]] = []
    outlines: list[BaseGeometry] = []
    for index in order:
        home = _home(index, groups, planes, outlines, observations, limit, gates.gap_m)
        if home is not None:
            frame = planes[groups[home][0]].frame
            outlines[home] = grow(outlines[home], observations[index].patch_in(inverse_transform(frame)))
            groups[home].append(index)
        elif may_start[index]:
            groups.append([index])
            outlines.append(observations[index].patch_in(inverse_transform(planes[index].frame)))
    return groups


def _home(
    index: int,
    groups: Sequence[Sequence[int]],
    planes: Sequence[Plane],
    outlines: Sequence[BaseGeometry],
    observations: Sequence[Observation],
    limit: float,
    gap_m: float,
) -> int | None:
    """The group whose plane is nearest in chi2, if it is near enough in chi2 and in place."""
    best: tuple[float, int] | None = None
    for number, group in enumerate(groups):
        first = planes[group[0]]
        distance = first.mahalanobis(planes[index])
        if distance > limit or (best is not None and distance >= best[0]):
            continue
        if outlines[number].distance(observations[index].patch_in(inverse_transform(first.frame))) <= gap_m:
            best = (distance, number)
    return None if best is None else best[1]


def _patch_size(observation: Observation) -> float:
    """Extent of what was seen, m: the diagonal of its corners' box."""
    vertices = observation.vertices
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))
