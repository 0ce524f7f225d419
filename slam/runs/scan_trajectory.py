"""The pose at every scan of a log: keyframes' estimates, and between them the odometry's motion made to meet both."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np

from slam.config import SlamConfig
from slam.errors import LogError
from slam.frontend.keyframes import track_of
from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from spplanes._check import FloatArray


def scan_stamps(log: Log) -> np.ndarray:
    """Times of all scans of a log, each once, ascending, shape (N,), int64, ns."""
    return np.unique(np.array([scan.stamp_ns for scan in log.scans()], dtype=np.int64))


def scan_trajectory(keyframes: Trajectory, log: Log, rig: Rig, config: SlamConfig) -> Trajectory:
    """world_T_body at every scan of a log, from the estimates of its keyframes, as `carried` carries them.

    The motion between them is what the keyframes were predicted by: laser odometry, odometry, or nothing.
    """
    try:
        track = track_of(log, rig, config)
    except LogError:  # 3D scans without odometry
        track = None
    return as_stamped(carried(keyframes, scan_stamps(log), track), log)


def given_at_scans(log: Log, mapped: Trajectory) -> Trajectory:
    """The poses that a log gives for its scans, each once; of scans that have none interpolated in time.

    Those of the scans `mapped` stand where another sensor's scan of the same time has another.
    """
    given = {scan.stamp_ns: scan.world_T_body for scan in log.scans() if scan.world_T_body is not None}
    given |= dict(zip(mapped.stamps_ns.tolist(), mapped.poses, strict=True))
    times = sorted(given)
    known = Trajectory(np.array(times, dtype=np.int64), np.array([given[time] for time in times]).reshape(-1, 4, 4))
    return as_stamped(carried(known, scan_stamps(log), None), log)


def as_stamped(scans: Trajectory, log: Log) -> Trajectory:
    """Poses of a log's scans by what these are stamped, which is what others know them by."""
    stamps, rows = np.unique(log.as_stamped(scans.stamps_ns.tolist()), return_index=True)
    return Trajectory(stamps, scans.poses[rows])


def odometry_of(log: Log, rig: Rig, trajectory: Trajectory, stamps_ns: np.ndarray | None = None) -> Trajectory:
    """Odometry alone through the first pose of a trajectory, at its times or at others (N,); empty without odometry."""
    if not log.odometry:
        return Trajectory.empty()
    start = Trajectory(trajectory.stamps_ns[:1], trajectory.poses[:1])
    times = trajectory.stamps_ns if stamps_ns is None else stamps_ns
    return carried(start, times, OdometryTrack(log.odometry, rig.odometry))


def carried(keyframes: Trajectory, stamps_ns: np.ndarray, track: OdometryTrack | None) -> Trajectory:
    """Poses at times (N,), strictly ascending, ns; at a keyframe's own time its estimate, bit for bit.

    Between two keyframes odometry tells the motion from the one before and to the one after. Where the two disagree
    the pose is a share of the geodesic of SE(3) between them: the share of the odometry's uncertainty that the way up
    to there has gathered, by the wheels' noise model, so that where the robot stands nothing moves. Without odometry
    the share is that of the time. Before the first keyframe and after the last, odometry alone; without it the pose
    stands.
    """
    if not len(keyframes) or not len(stamps_ns):
        return Trajectory.empty()
    stamps, known = np.asarray(stamps_ns, dtype=np.int64), keyframes.stamps_ns
    times = np.union1d(stamps, known)
    moved = np.tile(np.eye(4), (len(times), 1, 1)) if track is None else track.poses_at(times.tolist())
    gathered = np.zeros(len(times)) if track is None else _uncertainty(track, moved)
    at = np.searchsorted(times, known).tolist()
    before = np.clip(np.searchsorted(known, stamps, side="right") - 1, 0, len(known) - 1)
    after = np.minimum(before + (known[before] < stamps), len(known) - 1)
    here = np.searchsorted(times, stamps).tolist()
    poses = np.empty((len(stamps), 4, 4))
    for row, (place, a, b) in enumerate(zip(here, before.tolist(), after.tolist(), strict=True)):
        if known[a] == stamps[row]:
            poses[row] = keyframes.poses[a]
            continue
        poses[row] = keyframes.poses[a] @ inverse(moved[at[a]]) @ moved[place]
        if a != b and known[a] < stamps[row]:
            by_next = keyframes.poses[b] @ inverse(moved[at[b]]) @ moved[place]
            step = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(poses[row]) @ by_next))
            share = _share(gathered, times, at[a], place, at[b])
            poses[row] = poses[row] @ gtsam.Pose3.Expmap(share * step).matrix()
    return Trajectory(stamps, poses)


def _uncertainty(track: OdometryTrack, moved: FloatArray) -> FloatArray:
    """Variance that odometry has gathered up to each of its poses (N, 4, 4), shape (N,); a radian is as a metre."""
    steps = np.array([planar_delta(inverse(a) @ b) for a, b in pairwise(moved)]).reshape(-1, 3)
    return np.concatenate(([0.0], np.cumsum(track.step_variances(steps))))


def _share(gathered: FloatArray, times: np.ndarray, start: int, here: int, end: int) -> float:
    """How much of what the whole way gathers its first part does; of the time, where the whole way gathers nothing."""
    whole = gathered[end] - gathered[start]
    if whole > 0.0:
        return float((gathered[here] - gathered[start]) / whole)
    return int(times[here] - times[start]) / int(times[end] - times[start])
