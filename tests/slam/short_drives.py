"""The beginning of a drive of the corpus, mapped once a process, and how far off the truth its keyframes are."""

from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.corpus.drives import Drive, Recipe, make_drive
from slam.config import SlamConfig
from slam.runs.slam_run import Run, run_slam
from spplanes._check import FloatArray


@cache
def mapped_beginning(name: str, seed: int, n_scans: int | None = None) -> tuple[Run, FloatArray]:
    """A run of the first scans of a drive, or all, and the errors of its keyframes against the first one, (N, 4, 4)."""
    drive = make_drive(Recipe.parse(name), seed)
    end = drive.log.scans()[:n_scans][-1].stamp_ns
    events = [event for event in drive.log.events if event.stamp_ns <= end]
    run = run_slam(replace(drive.log, events=events), drive.rig, SlamConfig())
    return run, errors_of(run, drive)


def errors_of(run: Run, drive: Drive) -> FloatArray:
    """Errors of a run's keyframes against the first one, (N, 4, 4)."""
    true = drive.truth.world_T_body[np.searchsorted(drive.truth.stamps_ns, run.trajectory.stamps_ns)]
    moved, estimated = (np.linalg.inv(poses[0]) @ poses for poses in (true, run.trajectory.poses))
    return np.linalg.inv(moved) @ estimated
