"""Where a mission starts in the map of another: numbers on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.frontend.keyframes import Keyframe
from slam.registration.initial_pose import find_start
from slam.session.prior_map import PriorMap, floor_start, space_start
from spplanes.spmodel import transform_from_rpy

#: Instead of numbers: look for the start in the map.
FIND = "find"


def read_prior(path: Path, start: str, sigma: str, first: Callable[[], Keyframe]) -> PriorMap:
    """The prior map, and the start as words, m and deg: X,Y,HEADING on the floor, or X,Y,Z,YAW,PITCH,ROLL; its sigmas.

    `first` gives the first keyframe of the mission, where its start is to be found by what it sees.
    """
    numbers = _numbers("--start", "0,0,0" if start == FIND else start, 3, 6)
    sigma_m, sigma_deg = _numbers("--start-sigma", sigma, 2)
    if min(sigma_m, sigma_deg) <= 0.0:
        raise ValueError(f"--start-sigma: expected two positive numbers, got {sigma!r}")
    sigmas = sigma_m, float(np.deg2rad(sigma_deg))
    x, y, z, *turns = numbers if len(numbers) == 6 else (*numbers[:2], 0.0, numbers[2], 0.0, 0.0)
    world_T_start = transform_from_rpy((x, y, z, *np.deg2rad(turns).tolist()))
    prior = PriorMap.load(path, world_T_start=world_T_start, start_covariance=floor_start(*sigmas))
    if start == FIND:
        prior = replace(prior, world_T_start=find_start(prior.planes, first()))
    pose = prior.world_T_start
    if pose[2, 3] == 0.0 and pose[2, 2] == 1.0:
        return prior
    return replace(prior, start_covariance=space_start(*sigmas))


def _numbers(name: str, text: str, *counts: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"{name}: expected {wanted} numbers with commas between them, got {text!r}")
    return numbers
