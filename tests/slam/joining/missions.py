"""Missions to be joined: through one room, measured with the noise that their covariances tell, each in a frame of its
own; and through simulated offices, short and with a level laser alone, so that they are quick.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.corpus.drives import Recipe, make_drive
from benchmarks.corpus.drives.drive import Drive as OfficeDrive
from slam import Keyframe, SlamConfig
from slam.geometry.frames import planar_transform
from slam.joining import FinishedMission
from slam.output.run_files import write_run
from slam.output.run_folder import Source, conclude, new_run
from slam.runs.slam_run import run_slam
from tests.slam.scenes import Drive, drive, run_of

#: Where the second mission believes to begin: nobody tells it where the first did.
ELSEWHERE = planar_transform(5.0, -2.0, 2.0)


@cache
def scene(seed: int) -> Drive:
    return drive(seed)


@cache
def first(seed: int) -> FinishedMission:
    """A mission in the frame of the room."""
    return FinishedMission.of("first", run_of(scene(seed).keyframes))


@cache
def second(seed: int) -> FinishedMission:
    """Another one, in a frame of its own: where it is in the room's is `room_T_second`."""
    return second_of(scene(1000 + seed).keyframes)


def second_of(frames: list[Keyframe]) -> FinishedMission:
    return FinishedMission.of("second", run_of([replace(frames[0], world_T_body_guess=ELSEWHERE), *frames[1:]]))


def room_T_second(seed: int) -> np.ndarray:
    """The truth."""
    return scene(1000 + seed).world_T_body[0] @ np.linalg.inv(ELSEWHERE)


LEVEL = Recipe.parse("office/level")
#: Visits of one building: which part of the way, and whether backwards.
VISITS = (((0.0, 0.5), False), ((0.25, 0.75), True), ((0.5, 1.0), False))


@cache
def visit(seed: int, number: int, recipe: Recipe = LEVEL) -> OfficeDrive:
    part, backwards = VISITS[number]
    return make_drive(recipe, seed, visit=number, part=part, backwards=backwards)


@cache
def office(seed: int, number: int = 0) -> FinishedMission:
    given = visit(seed, number)
    return FinishedMission.of(f"office-{seed}-{number}", run_slam(given.log, given.rig, SlamConfig()).slam, given.rig)


def write_office(folder: Path, seed: int, number: int) -> Path:
    """A run's folder, as `spplanes slam` leaves it, of every second scan."""
    given, log = visit(seed, number, replace(LEVEL, disturbance="half")), folder.with_suffix(".log")
    log.write_text(folder.name, encoding="utf-8")
    with new_run(folder, given.log, given.rig, SlamConfig(), Source(log), prior=None, overwrite=False) as (slam, *_):
        run = run_slam(given.log, given.rig, SlamConfig(), slam=slam)
        conclude(run, folder, lambda work: write_run(run, work, title=folder.name))
    return folder
