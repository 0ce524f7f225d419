"""A run from log to map: keyframes through `PlaneSlam`, with the time of every stage."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from slam.config import SlamConfig
from slam.diagnostics.verdict import Verdict
from slam.frontend.deskewing import Sweeps
from slam.frontend.input_checks import KeyframeError, without_repetitions
from slam.frontend.keyframes import count_keyframes, keyframes_of
from slam.frontend.range_noise import with_shown_errors
from slam.io.plausibility import check_events
from slam.io.trajectories import Trajectory
from slam.joining.join import Progress
from slam.planeslam import MapPlane, PlaneSlam
from slam.runs.compensation import compensated
from slam.runs.repair import Repair, assessed, repaired
from slam.runs.scan_trajectory import as_stamped, odometry_of, scan_stamps, scan_trajectory
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from slam.timing import StageClock
from spplanes._check import as_count

__all__ = ["Progress", "Run", "StageClock", "odometry_of", "path_length_m", "run_slam"]


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run."""

    slam: PlaneSlam
    """The estimator in its final state."""
    planes: list[MapPlane]
    trajectory: Trajectory
    """world_T_body of every keyframe."""
    odometry: Trajectory
    """The same keyframes by odometry alone, from the same first pose."""
    log: Log
    rig: Rig
    clock: StageClock
    repairs: tuple[Repair, ...] | None = None
    """What was mended when it had ended; None: that was not asked for."""
    judged: Verdict | None = None
    """The verdict, where it is known."""

    @cached_property
    def scan_trajectory(self) -> Trajectory:
        """world_T_body at every scan of the log: the keyframes' estimates, the motion between them carried."""
        return scan_trajectory(self.trajectory, self.log, self.rig, self.slam.config)

    @cached_property
    def scan_odometry(self) -> Trajectory:
        """The same scans by odometry alone, from the first keyframe's estimate; empty without odometry."""
        return as_stamped(odometry_of(self.log, self.rig, self.trajectory, scan_stamps(self.log)), self.log)

    @cached_property
    def verdict(self) -> Verdict:
        """Sound, doubtful or broken, and why."""
        return assessed(self.slam, self.rig) if self.judged is None else self.judged


@threadpool_limits.wrap(limits=1, user_api="blas")  # small matrices: threads that wait for more cost up to a third
def run_slam(
    log: Log,
    rig: Rig,
    config: SlamConfig,
    *,
    slam: PlaneSlam | None = None,
    batch: bool = False,
    repair: bool = True,
    jobs: int = 1,
    clock: StageClock | None = None,
    progress: Progress | None = None,
) -> Run:
    """Estimate trajectory and planes of a log.

    Args:
        log, rig, config: what to work on, with which sensors, and how; of ranges that show more noise than the rig
            states what they show is taken, with a note in the log (`slam.frontend.range_noise`).
        slam: an estimator to go on with, which has the first keyframes of the log already; None: a new one.
        batch: solve the same graph once more as a whole at the end.
        repair: mend a map that is found to be wrong where the drive tells how (`slam.runs.repair`).
        jobs: processes that measure keyframes while the estimate goes on; the result is the same to the bit.
        clock: takes the time of every stage.
        progress: is told how many keyframes are done, and how many there are.

    Raises:
        LogError: the log lacks what the rig needs, or has events that are out of order or not what they should be.
        ValueError: fewer jobs than one.
    """
    if as_count("jobs", jobs) < 1:
        raise ValueError(f"jobs: expected at least 1, got {jobs}")
    check_events(log)
    clock = clock or StageClock()
    slam = slam or PlaneSlam(config)
    slam.clock = slam.backend.clock = clock
    with clock.stage("measure"):  # what shows the noise
        rig = with_shown_errors(log, rig)
    done_before = len(slam.keyframes)
    _add_keyframes(slam, log, rig, config, jobs, progress)

    def map_again(rig: Rig, sweeps: Sweeps | None) -> PlaneSlam:
        other = slam.anew(slam.prior)
        _add_keyframes(other, log, rig, config, jobs, progress, sweeps)
        return other

    has_more = len(slam.keyframes) > done_before
    if (turning := compensated(slam, log, rig, map_again, has_more=has_more)) is not None:
        turning.slam.supersede_measured(slam, turning.rig)
        slam, rig = turning
    repairs, judged = None, None
    if repair:
        with clock.stage("repair"):
            slam, judged, repairs = repaired(slam, rig, progress)
    if batch:
        judged = None  # it was on another map
        with clock.stage("batch"):
            slam.adopt_batch()
    with clock.stage("map"):
        planes = slam.planes
    trajectory = slam.trajectory
    odometry = odometry_of(log, rig, trajectory)
    return Run(slam, planes, trajectory, odometry, log, rig, clock, repairs, judged)


def _add_keyframes(
    slam: PlaneSlam,
    log: Log,
    rig: Rig,
    config: SlamConfig,
    jobs: int,
    progress: Progress | None,
    sweeps: Sweeps | None = None,
) -> None:
    """Add the keyframes of a log that the estimator does not have. Of one that is refused what it saw is left out, with
    a note.
    """
    clock, done_before = slam.clock, len(slam.keyframes)
    with clock.stage("measure"):  # laser odometry, which says where keyframes are
        total = count_keyframes(log, rig, config)
    how = {"segment": slam.segment, "jobs": jobs, "sweeps": sweeps}
    with closing(keyframes_of(log, rig, config, done_before, **how)) as measured:
        frames = without_repetitions(measured)
        for done in range(done_before, total):
            with clock.stage("measure"):
                keyframe = next(frames)
            with clock.stage("estimate"):
                try:
                    slam.add_keyframe(keyframe)
                except KeyframeError as error:  # any other came after it had entered
                    if config.keyframes.strict:
                        raise
                    slam.add_keyframe(replace(keyframe, observations=[], notes=(*keyframe.notes, str(error))))
            if progress is not None:
                progress(done + 1, total)


def path_length_m(trajectory: Trajectory) -> float:
    """Length of a trajectory, m."""
    return float(np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1).sum())
