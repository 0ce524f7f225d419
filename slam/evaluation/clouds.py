"""How sharp the 3D scans of a run make the map: by the run's poses, and by those of somebody else."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.evaluation.metrics import Metric
from slam.evaluation.sharpness import compare_sharpness
from slam.evaluation.trajectories import common_poses
from slam.frontend.measurement import usable_points
from slam.geometry.frames import lift
from slam.io.load import load
from slam.io.trajectories import Trajectory, read_tum
from slam.sensors.log import CloudScan
from slam.sensors.rig import Rig
from slam.session.state import session_path
from slam.session.store import Session
from spplanes._check import FloatArray

#: So many points of all scans together are enough, evenly taken.
_ENOUGH = 600_000


def sharpness_of_run(run: Path, reference: Trajectory, log: Path) -> list[Metric]:
    """Median distance of points from the planes that scans share, by trajectory.tum of a run and by a reference.

    Args:
        run: the folder of a run; its session tells the rig.
        reference: world_T_body by somebody else, at times of the run.
        log: what the run was made from; its 3D scans are read again.

    Raises:
        LogError: a log without 3D scans at the times of the poses, or one that cannot be read.
        ValueError: run and reference have no times in common.
    """
    stamps, poses, others = common_poses(read_tum(run / "trajectory.tum"), reference)
    source, rig = load(log, _rig_of(run))
    scans = {scan.stamp_ns: scan for scan in source.scans() if isinstance(scan, CloudScan)}
    found = [k for k, stamp in enumerate(stamps.tolist()) if stamp in scans]
    if not found:
        raise LogError(log, "expected 3D scans at the times of the run's poses, found none")
    clouds = [_in_body(scans[stamps[k]], rig) for k in found]
    every = max(sum(map(len, clouds)) // _ENOUGH, 1)
    return compare_sharpness([cloud[::every] for cloud in clouds], poses[found], others[found]).metrics()


def _rig_of(run: Path) -> Rig | None:
    """The rig that a run was made with; None where it kept no session: then that of the log."""
    if not session_path(run).is_file():
        return None
    with Session.open(run, read_only=True) as session:
        return session.rig


def _in_body(scan: CloudScan, rig: Rig) -> FloatArray:
    """Points (N, 3) of a scan in the body's frame, those that its sensor can tell."""
    sensor = rig.sensors[scan.sensor]
    points = usable_points(np.asarray(scan.points, dtype=np.float64), sensor).reshape(-1, 3)
    return lift(points[np.isfinite(points).all(axis=1)], sensor.body_T_sensor)
