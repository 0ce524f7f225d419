"""The beginning of a drive of the corpus, mapped once a process, and how far off the truth its keyframes are."""

from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.corpus.drives import Drive, Recipe, make_drive
from slam.config import SlamConfig
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import Event, Log, OdometryReading
from spplanes._check import FloatArray


def until(log: Log, end_ns: int) -> Log:
    """Its beginning, up to a time."""
    return replace(log, events=[event for event in log.events if event.stamp_ns <= end_ns])


def with_jump(log: Log, at_ns: int, off: FloatArray) -> Log:
    """With readings of the odometry moved from a time on, by a transform (4, 4) of their world."""

    def moved(event: Event) -> Event:
        jumped = isinstance(event, OdometryReading) and event.stamp_ns >= at_ns
        return replace(event, odom_T_body=off @ event.odom_T_body) if jumped else event

    return replace(log, events=[moved(event) for event in log.events], notes=[])


@cache
def mapped_beginning(name: str, seed: int, n_scans: int | None = None) -> tuple[Run, FloatArray]:
    """A run of the first scans of a drive, or all, and the errors of its keyframes against the first one, (N, 4, 4)."""
    drive = make_drive(Recipe.parse(name), seed)
    run = run_slam(until(drive.log, drive.log.scans()[:n_scans][-1].stamp_ns), drive.rig, SlamConfig())
    return run, errors_of(run, drive)


def errors_of(run: Run, drive: Drive) -> FloatArray:
    """Errors of a run's keyframes against the first one, (N, 4, 4)."""
    true = drive.truth.poses_at(run.trajectory.stamps_ns)
    moved, estimated = (np.linalg.inv(poses[0]) @ poses for poses in (true, run.trajectory.poses))
    return np.linalg.inv(moved) @ estimated
