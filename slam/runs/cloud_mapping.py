"""Mapping of 3D scans at given poses: planes of every scan, joined where they are one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.config import SlamConfig
from slam.errors import LogError
from slam.frontend.keyframes import Keyframe
from slam.frontend.measurement import planes_of_cloud
from slam.frontend.observations import PlaneObservation
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane, PlaneSlam
from slam.runs.slam_run import Progress, StageClock
from slam.sensors.log import CloudScan, Log, StoredCloud
from slam.sensors.rig import Rig
from spplanes._check import FloatArray

#: The poses are given: between two of them the graph may give way by this much only, m and rad. Their real error is in
#: the planes.
_HELD_M, _HELD_RAD = 1e-4, 1e-5


def map_clouds(
    log: Log, rig: Rig, config: SlamConfig, clock: StageClock, progress: Progress | None
) -> tuple[list[MapPlane], Trajectory, int, int]:
    """Planes of the 3D scans of a log, at the poses that the log gives.

    The error of a scan's pose, `rig.localisation`, is added to the covariance of its planes: scan by scan on its own,
    as if the errors of neighbouring poses had nothing in common.

    Returns:
        The planes, the poses, the number of returns in all scans, and of those that belong to a plane.

    Raises:
        LogError: a scan without a pose.
    """
    scans = [scan for scan in log.scans() if isinstance(scan, CloudScan) and scan.sensor in rig.of_kind("cloud")]
    poses = [_pose_of(scan, log) for scan in scans]
    slam = PlaneSlam(_for_given_poses(config))
    location = None if rig.localisation is None else rig.localisation.location_covariance()
    n_seen = n_represented = 0
    for index, scan in enumerate(scans):
        with clock.stage("measure"):
            whole = scan.loaded() if isinstance(scan, StoredCloud) else scan
            seen = planes_of_cloud(whole, rig.sensors[scan.sensor], config)
        n_seen += int(np.isfinite(whole.points[..., 0]).sum())
        n_represented += sum(one.n_points for one in seen)
        with clock.stage("map"):
            slam.add_keyframe(_keyframe(scan, [_placed(one, location) for one in seen], poses[: index + 1][-2:]))
        if progress is not None:
            progress(index + 1, len(scans))
    with clock.stage("map"):
        planes = slam.planes
    stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    return planes, Trajectory(stamps, np.array(poses)), n_seen, n_represented


def _keyframe(scan: CloudScan, seen: Sequence[PlaneObservation], poses: Sequence[FloatArray]) -> Keyframe:
    """A keyframe at the last of the poses; with one before it, held to that."""
    if len(poses) == 1:
        return Keyframe(scan.stamp_ns, seen, world_T_body_guess=poses[0])
    held = np.diag([_HELD_M**2] * 3 + [_HELD_RAD**2] * 3)
    return Keyframe(scan.stamp_ns, seen, Motion(inverse(poses[0]) @ poses[1], held, (_HELD_M, _HELD_RAD, _HELD_RAD)))


def _placed(seen: PlaneObservation, location: FloatArray | None) -> PlaneObservation:
    """The plane as known from a pose that is known only so well."""
    return seen if location is None else replace(seen, plane=seen.plane.transform(np.eye(4), location))


def _for_given_poses(config: SlamConfig) -> SlamConfig:
    """No loops are looked for, and what one scan has seen is in the map."""
    loops = config.loops.model_copy(update={"max_candidates": 0})
    landmarks = config.landmarks.model_copy(update={"min_observations": 1})
    return config.model_copy(update={"loops": loops, "landmarks": landmarks})


def _pose_of(scan: CloudScan, log: Log) -> FloatArray:
    if scan.world_T_body is None:
        raise LogError(log.source, f"expected a pose with every scan of {scan.sensor!r}, got one without; use slam")
    return scan.world_T_body
