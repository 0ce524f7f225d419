"""Missions through one room, measured with the noise that their covariances tell, each in a frame of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from slam.geometry.frames import planar_transform
from slam.joining import FinishedMission
from tests.slam.scenes import Drive, drive, run_of

#: Where the second mission believes to begin: nobody tells it where the first did.
ELSEWHERE = planar_transform(5.0, -2.0, 2.0)


@cache
def scene(seed: int) -> Drive:
    return drive(seed)


@cache
def first(seed: int) -> FinishedMission:
    """A mission in the frame of the room."""
    return mission("first", scene(seed))


@cache
def second(seed: int) -> FinishedMission:
    """Another one, in a frame of its own: where it is in the room's is `room_T_second`."""
    frames = scene(1000 + seed).keyframes
    elsewhere = Drive([replace(frames[0], world_T_body_guess=ELSEWHERE), *frames[1:]], scene(1000 + seed).world_T_body)
    return mission("second", elsewhere)


def room_T_second(seed: int) -> np.ndarray:
    """The truth."""
    return scene(1000 + seed).world_T_body[0] @ np.linalg.inv(ELSEWHERE)


def mission(name: str, given: Drive) -> FinishedMission:
    slam = run_of(given.keyframes)
    return FinishedMission.of(name, slam)
