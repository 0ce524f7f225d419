"""Landmark initialization: which planes may start a landmark, and which of a keyframe are one plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri
from shapely.geometry.base import BaseGeometry

from slam.config import AssociationConfig, LandmarkConfig
from slam.frontend.observations import LineObservation, Observation
from slam.geometry.frames import inverse
from slam.geometry.polygons import grow
from spplanes import Plane

#: A plane of so many points whose tilt is known to this share of what is asked starts a landmark though it has only
#: this share of the area asked: a push-broom window sees half a metre of anything.
FIRM_POINTS, FIRM_TILT, FIRM_AREA = 200, 0.2, 0.5


def may_start(observation: Observation, rules: LandmarkConfig) -> bool:
    """Whether a measurement is firm enough to start a landmark."""
    if isinstance(observation, LineObservation):
        ends = observation.vertices
        long_enough = float(np.linalg.norm(ends[1] - ends[0])) >= rules.min_line_length_m
        return long_enough and observation.n_points >= rules.min_line_points
    plane = observation.full_plane(0.0)
    tilt = float(np.sqrt(np.linalg.eigvalsh(plane.covariance[1:, 1:])[-1]))
    return (is_large(plane, rules) and tilt <= rules.max_tilt_sigma_rad) or _is_firm(plane, tilt, rules)


def _is_firm(plane: Plane, tilt: float, rules: LandmarkConfig) -> bool:
    """Whether a patch too small to start a landmark is too sure to be the edge of something: the front of a lamp."""
    return (
        plane.n_points >= FIRM_POINTS
        and tilt <= FIRM_TILT * rules.max_tilt_sigma_rad
        and plane.outline is not None
        and plane.outline.area >= FIRM_AREA * rules.min_area_m2
    )


def is_large(plane: Plane, rules: LandmarkConfig) -> bool:
    """Whether a patch is large enough to be more than the edge of something."""
    return plane.n_points >= rules.min_points and (plane.outline is None or plane.outline.area >= rules.min_area_m2)


def group_new(
    observations: Sequence[Observation], rules: LandmarkConfig, association: AssociationConfig
) -> list[list[int]]:
    """Gather measurements of one keyframe that are one plane; the first of each group, the firmest, starts it.

    They share a pose, so the chi2 of two of them needs no state: it is that of two planes of one frame. Measurements
    that may not start a landmark join a group but do not make one.

    Returns:
        Groups of indices into `observations`, in order of their first member.
    """
    limit = float(chdtri(3, association.significance))
    planes = [observation.full_plane(rules.wall_tilt_sigma_rad) for observation in observations]
    order = sorted(range(len(observations)), key=lambda index: (-_patch_size(observations[index]), index))
    groups: list[list[int]] = []
    outlines: list[BaseGeometry] = []
    for index in order:
        home = _home(index, groups, planes, outlines, observations, limit, association.gap_m)
        if home is not None:
            frame = planes[groups[home][0]].frame
            outlines[home] = grow(outlines[home], observations[index].patch_in(inverse(frame)))
            groups[home].append(index)
        elif may_start(observations[index], rules):
            groups.append([index])
            outlines.append(observations[index].patch_in(inverse(planes[index].frame)))
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
        if outlines[number].distance(observations[index].patch_in(inverse(first.frame))) <= gap_m:
            best = (distance, number)
    return None if best is None else best[1]


def _patch_size(observation: Observation) -> float:
    """Extent of what was seen, m: the diagonal of its corners' box."""
    vertices = observation.vertices
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))
