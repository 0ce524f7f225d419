"""The paper's mapping: poses given, planes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely

from factors.association.observations import PlaneObservation
from slam.config import SlamConfig
from slam.errors import LogError
from slam.frontend.keyframes import Keyframe
from slam.frontend.measurement import for_sensor, planes_of_cloud, usable_ranges
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane, PlaneSlam
from slam.runs.scan_trajectory import given_at_scans
from slam.runs.slam_run import Progress, StageClock
from slam.sensors.log import CloudScan, LaserScan, Log, StoredCloud
from slam.sensors.rig import Rig, Sensor
from slam.sensors.scan_noise import model_of
from slam.tracking.turns import sweeps_of
from spplanes import MapperConfig, PlaneMapper
from spplanes._check import FloatArray
from spplanes.registration import register_scans


@dataclass(frozen=True, eq=False)
class MapResult:
    """A finished map."""

    planes: list[MapPlane]
    """In the frame of the given poses."""
    trajectory: Trajectory
    """The poses that were given."""
    scan_trajectory: Trajectory
    """world_T_body at every scan of the log, those of other sensors too."""
    odometry: Trajectory
    """Empty: the poses are given."""
    n_points_seen: int
    """Returns in all scans."""
    n_points_represented: int
    """Those that belong to a plane."""
    clock: StageClock


def run_map(
    log: Log, rig: Rig, config: SlamConfig, *, clock: StageClock | None = None, progress: Progress | None = None
) -> MapResult:
    """Planes of the scans of a log, at the poses that the log gives, with the localisation's covariance.

    A log with 3D scans is mapped by them, any other by its push-broom laser. LogError: none of either, scans without a
    pose or out of time order, or beam counts that change.
    """
    clock = clock or StageClock()
    clouds = [scan for scan in log.scans() if isinstance(scan, CloudScan) and scan.sensor in rig.of_kind("cloud")]
    if clouds:
        return _map_clouds(clouds, log, rig, config, clock, progress)
    return _map_slices(log, rig, config, clock, progress)


def _map_slices(log: Log, rig: Rig, config: SlamConfig, clock: StageClock, progress: Progress | None) -> MapResult:
    name, sensor = _slice_sensor(log, rig)
    scans = [scan for scan in log.scans(name) if isinstance(scan, LaserScan)]
    _check_alike(scans, log)
    pose_covariance = None if rig.localisation is None else rig.localisation.location_covariance()
    mapper = PlaneMapper(correlated(for_sensor(config.mapper, sensor), scans, rig, log))
    for done, scan in enumerate(scans):
        with clock.stage("register"):
            placed = register_scans(
                usable_ranges(scan.ranges, sensor)[None],
                scan.angles,
                _pose_of(scan, log)[None],
                model_of(sensor),
                body_T_sensor=sensor.body_T_sensor,
                pose_covariances=pose_covariance,
            )
        with clock.stage("map"):
            mapper.add_scan(
                placed.points[0],
                placed.covariances[0],
                viewpoint=placed.viewpoints[0],
                pose_covariance=None if placed.pose_covariances is None else placed.pose_covariances[0],
                scan_origin=placed.scan_origins[0],
            )
        if progress is not None:
            progress(done + 1, len(scans))
    with clock.stage("map"):
        planes = mapper.planes
    stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    poses = Trajectory(stamps, np.array([_pose_of(scan, log) for scan in scans]))
    found = [MapPlane(k, plane, plane.outline or shapely.Polygon(), 1, ("map",)) for k, plane in enumerate(planes)]
    at_scans, counts = given_at_scans(log, poses), (mapper.n_points_seen, mapper.n_points_represented)
    return MapResult(found, poses, at_scans, Trajectory.empty(), *counts, clock)


def correlated(config: MapperConfig, scans: list[LaserScan], rig: Rig, log: Log) -> MapperConfig:
    """The settings with the number of scans over which the localisation's error stays nearly the same."""
    if rig.localisation is None or len(scans) < 2:
        return config
    places = np.array([_pose_of(scan, log)[:3, 3] for scan in scans])
    spacing_m = float(np.linalg.norm(np.diff(places, axis=0), axis=1).mean())
    if spacing_m <= 0.0:
        return config
    return replace(config, pose_correlation_scans=rig.localisation.correlation_length_m / spacing_m)


def _slice_sensor(log: Log, rig: Rig) -> tuple[str, Sensor]:
    """The push-broom laser: the one in the rig that has scans in the log."""
    for name, sensor in rig.of_kind("slice").items():
        if log.scans(name):
            return name, sensor
    raise LogError(log.source, "expected scans of a sensor that the rig calls slice (push-broom), found none")


def _check_alike(scans: list[LaserScan], log: Log) -> None:
    """Raise where time runs backwards from scan to scan or the number of beams changes."""
    for before, scan in pairwise(scans):
        if scan.stamp_ns < before.stamp_ns:
            times = f"got {scan.stamp_ns} ns after {before.stamp_ns} ns"
            raise LogError(log.source, f"expected scans of {scan.sensor!r} in time order, {times}")
        wanted, got = len(before.ranges), len(scan.ranges)
        if got != wanted:
            raise LogError(log.source, f"expected {wanted} beams in every scan of {scan.sensor!r}, got {got}")


def _pose_of(scan: LaserScan | CloudScan, log: Log) -> FloatArray:
    if scan.world_T_body is None:
        raise LogError(log.source, f"expected a pose with every scan of {scan.sensor!r}, got one without; use slam")
    return scan.world_T_body


#: The poses are given: between two of them the graph may give way by this much only, m and rad. Their real error is in
#: the planes.
_HELD_M, _HELD_RAD = 1e-4, 1e-5


def _map_clouds(
    scans: list[CloudScan], log: Log, rig: Rig, config: SlamConfig, clock: StageClock, progress: Progress | None
) -> MapResult:
    """Planes of the 3D scans of a log, at the poses that the log gives; LogError: a scan without one.

    The error of a scan's pose, `rig.localisation`, is added to the covariance of its planes: scan by scan on its own,
    as if the errors of neighbouring poses had nothing in common.
    """
    poses = [_pose_of(scan, log) for scan in scans]
    # no loops are looked for, and what one scan has seen is in the map
    loops = config.loops.model_copy(update={"max_candidates": 0})
    landmarks = config.landmarks.model_copy(update={"min_observations": 1})
    slam = PlaneSlam(config.model_copy(update={"loops": loops, "landmarks": landmarks}))
    location = None if rig.localisation is None else rig.localisation.location_covariance()
    n_seen = n_represented = 0
    given = Trajectory(np.array([scan.stamp_ns for scan in scans], dtype=np.int64), np.array(poses))
    sweeps = sweeps_of(given, rig.sensors.values())
    for index, scan in enumerate(scans):
        with clock.stage("measure"):
            whole = scan.loaded() if isinstance(scan, StoredCloud) else scan
            seen = planes_of_cloud(whole, rig.sensors[scan.sensor], config, sweeps)
        n_seen += int(np.isfinite(whole.points[..., 0]).sum())
        n_represented += sum(one.n_points for one in seen)
        with clock.stage("map"):
            if location is not None:
                seen = [replace(one, plane=one.plane.transform(np.eye(4), location)) for one in seen]
            slam.add_keyframe(_keyframe(scan, seen, poses[: index + 1][-2:]))
        if progress is not None:
            progress(index + 1, len(scans))
    with clock.stage("map"):
        planes = slam.planes
    return MapResult(planes, given, given_at_scans(log, given), Trajectory.empty(), n_seen, n_represented, clock)


def _keyframe(scan: CloudScan, seen: Sequence[PlaneObservation], poses: Sequence[FloatArray]) -> Keyframe:
    """A keyframe at the last of the poses; with one before it, held to that."""
    if len(poses) == 1:
        return Keyframe(scan.stamp_ns, seen, world_T_body_guess=poses[0])
    held = np.diag([_HELD_M**2] * 3 + [_HELD_RAD**2] * 3)
    return Keyframe(scan.stamp_ns, seen, Motion(inverse(poses[0]) @ poses[1], held, (_HELD_M, _HELD_RAD, _HELD_RAD)))
