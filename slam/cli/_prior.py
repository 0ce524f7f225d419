"""Where a mission starts in the map of another: numbers on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.frontend.keyframes import Keyframe
from slam.geometry.frames import planar_transform
from slam.registration.initial_pose import find_start
from slam.session.prior_map import PriorMap, floor_start

#: Instead of numbers: look for the start in the map.
FIND = "find"


def read_prior(path: Path, start: str, sigma: str, first: Callable[[], Keyframe]) -> PriorMap:
    """The prior map, and the start as words: X,Y,HEADING and their standard deviations, m and deg.

    `first` gives the first keyframe of the mission, where its start is to be found by what it sees.
    """
    x, y, heading = _numbers("--start", "0,0,0" if start == FIND else start, 3)
    sigma_m, sigma_deg = _numbers("--start-sigma", sigma, 2)
    if min(sigma_m, sigma_deg) <= 0.0:
        raise ValueError(f"--start-sigma: expected two positive numbers, got {sigma!r}")
    world_T_start = planar_transform(x, y, float(np.deg2rad(heading)))
    covariance = floor_start(sigma_m, float(np.deg2rad(sigma_deg)))
    prior = PriorMap.load(path, world_T_start=world_T_start, start_covariance=covariance)
    return replace(prior, world_T_start=find_start(prior.planes, first())) if start == FIND else prior


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name}: expected {count} numbers with commas between them, got {text!r}")
    return numbers
