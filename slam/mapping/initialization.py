"""Landmark initialization: which planes may start a landmark, and which of a keyframe are one plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factors.association.grouping import group_planes
from slam.association.data_association import gates_of
from slam.config import AssociationConfig, LandmarkConfig
from slam.frontend.observations import LineObservation, Observation
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

    Measurements that may not start a landmark join a group but do not make one.

    Returns:
        Groups of indices into `observations`, in order of their first member.
    """
    firm = [may_start(observation, rules) for observation in observations]
    return group_planes(observations, gates_of(association), rules.wall_tilt_sigma_rad, firm)
