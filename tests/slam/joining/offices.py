"""Missions through simulated offices, short and with a level laser alone, so that they are quick."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from benchmarks.corpus.drives import Recipe, make_drive
from benchmarks.corpus.drives.drive import Drive
from slam import SlamConfig
from slam.joining import FinishedMission
from slam.output.run_files import write_run
from slam.output.run_folder import Source, conclude, new_run
from slam.runs.slam_run import run_slam

LEVEL = Recipe.parse("office/level")
#: Visits of one building: which part of the way, and whether backwards.
VISITS = (((0.0, 0.5), False), ((0.25, 0.75), True), ((0.5, 1.0), False))


@cache
def visit(seed: int, number: int) -> Drive:
    part, backwards = VISITS[number]
    return make_drive(LEVEL, seed, visit=number, part=part, backwards=backwards)


@cache
def office(seed: int, number: int = 0) -> FinishedMission:
    drive = visit(seed, number)
    return FinishedMission.of(f"office-{seed}-{number}", run_slam(drive.log, drive.rig, SlamConfig()).slam, drive.rig)


def write_office(folder: Path, seed: int, number: int) -> Path:
    """A run's folder, as `spplanes slam` leaves it."""
    drive, log = visit(seed, number), folder.with_suffix(".log")
    log.write_text(folder.name, encoding="utf-8")
    with new_run(folder, drive.log, drive.rig, SlamConfig(), Source(log), prior=None, overwrite=False) as slam:
        run = run_slam(drive.log, drive.rig, SlamConfig(), slam=slam)
        conclude(run, folder, lambda work: write_run(run, work, title=folder.name))
    return folder
