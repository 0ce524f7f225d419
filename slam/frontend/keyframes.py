"""Keyframes: where a log is cut, and what each piece saw, in the frame of the body at that moment."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from factors.association.observations import Observation
from slam.ahead import ordered_parallel_map
from slam.config import SlamConfig
from slam.errors import LogError
from slam.frontend.deskewing import Sweeps, unswept
from slam.frontend.laser_odometry.stalled_wheels import Stall, over_stalls, stalls_of
from slam.frontend.laser_odometry.track import LaserTrack, motion_between
from slam.frontend.laser_odometry.tracker import laser_track
from slam.frontend.measurement import (
    ScanMeasurement,
    Segment,
    lines_of_scan,
    measured_cloud,
    planes_of_window,
    usable_ranges,
)
from slam.frontend.occupancy.raster import beams_of
from slam.frontend.odometry import Motion, OdometryTrack
from slam.frontend.pose_measurements import PlaceMatch, PoseMeasurement
from slam.geometry.frames import are_apart, inverse
from slam.io.trajectories import nearest_stamp
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray
from spplanes.segmentation.scans import label_scans


@dataclass(frozen=True, eq=False)
class Keyframe:
    """One pose of the trajectory and what was seen from it."""

    stamp_ns: int
    """Time of the pose, ns."""
    observations: Sequence[Observation]
    """Planes and lines in the body frame, in an order that depends on the data alone."""
    motion: Motion | None = None
    """Motion from the keyframe before; None for the first one, and where nobody measured it."""
    world_T_body_guess: FloatArray | None = None
    """Where the first pose is, shape (4, 4); None: at the origin."""
    notes: tuple[str, ...] = field(default=())
    """Scans that could not be used, one sentence each."""
    scans: tuple[LaserScan | CloudScan, ...] = field(default=())
    """The raw scans it was measured from; the estimator does without them."""
    returns: FloatArray | None = None
    """Beams of level lasers that met a surface, in the body's plane of motion, rows (x0, y0, x1, y1), shape (N, 4), m:
    what loops are verified with; None: no such laser."""
    pose_measurements: Sequence[PoseMeasurement] = field(default=())
    """What is known of the pose beside motion and planes: gravity from an IMU, say."""
    surfaces: FloatArray | None = None
    """Surface elements of a 3D scan in the body frame, rows (point, direction, sigma, kind, width), shape (N, 9), m:
    what motion is registered by beside the planes; see `slam.frontend.scan_surfaces`. None: no 3D scan."""
    viewpoint: FloatArray | None = None
    """Where the sensor of that scan was, in the body frame, shape (3,), m; None: at the body's origin."""
    places: Sequence[PlaceMatch] = field(default=())
    """Where it is from earlier ones, by whoever looked beyond the estimate: loops that need not be looked for."""


def keyframes_of(
    log: Log,
    rig: Rig,
    config: SlamConfig,
    start: int = 0,
    *,
    segment: Segment = label_scans,
    jobs: int = 1,
    sweeps: Sweeps | None = None,
) -> Generator[Keyframe, None, None]:
    """Cut a log into keyframes, in time order.

    Every 3D scan is a keyframe by itself. Without 3D scans, keyframes lie on scans of the line lasers (or of the
    push-broom lasers, if there are no others) by distance and angle of the odometry; the push-broom scans nearest to a
    keyframe are its window, so that each of them is used once. The first `start` keyframes are left out unmeasured:
    those a session has already. `segment` finds the planes of 3D scans and of push-broom windows. So many `jobs`
    measure ahead of whoever takes the keyframes; what they are does not depend on it. During the turns of a spinning
    lidar that takes time over them (`Sensor.sweep_s`) the body moves by `sweeps`; None: by the odometry, if any.

    Raises:
        LogError: no scan of a sensor that the rig knows, or no odometry where it is needed.
    """
    clouds = _clouds_of(log, rig, config.keyframes.strict)
    if clouds:
        # without odometry the estimator finds the motion by the planes
        track = _track_of(log, rig) if log.measured_motion else None
        measure, count = partial(_of_cloud, clouds, (track, sweeps), rig, config, segment), len(clouds)
    else:
        measure = _Lasers(log, rig, config, segment)
        count = len(measure.stamps)
    yield from ordered_parallel_map(measure, range(start, count), jobs, shared=log.events)


def count_keyframes(log: Log, rig: Rig, config: SlamConfig) -> int:
    """How many keyframes `keyframes_of` will give, without making them."""
    return len(_clouds_of(log, rig, config.keyframes.strict) or _choose_stamps(log, rig, config))


def _of_cloud(
    clouds: Sequence[tuple[CloudScan, list[str]]],
    tracks: tuple[OdometryTrack | None, Sweeps | None],
    rig: Rig,
    config: SlamConfig,
    segment: Segment,
    index: int,
) -> Keyframe:
    """The keyframe that is the 3D scan of an index; by tracks of the odometry, and of the motion within its turn."""
    (scan, late), seen, (track, sweeps) = clouds[index], ScanMeasurement(), tracks
    sensor, notes = rig.sensors[scan.sensor], [*late]
    with _noted(scan.stamp_ns, config, notes):
        if sweeps is None and track is not None and sensor.sweep_s > 0.0:
            sweeps = Sweeps.of_wheels(track, scan.stamp_ns, sensor.sweep_s)
        seen = measured_cloud(scan, sensor, config, segment, sweeps)
    return Keyframe(
        scan.stamp_ns,
        seen.observations,
        track.motion(clouds[index - 1][0].stamp_ns, scan.stamp_ns) if index and track is not None else None,
        notes=tuple(notes),
        scans=(scan,),
        surfaces=seen.surfaces,
        viewpoint=None if seen.surfaces is None else sensor.body_T_sensor[:3, 3].copy(),
    )


class _Lasers:
    """Measures keyframes out of 2D scans: each takes those that it is the nearest keyframe of."""

    def __init__(self, log: Log, rig: Rig, config: SlamConfig, segment: Segment) -> None:
        self._rig, self._config, self._segment = rig, config, segment
        self._track = track_of(log, rig, config)
        self._wheels = _track_of(log, rig) if log.measured_motion else None
        self._within = self._wheels or self._track  # over the time of a scan wheels err by less than two matched scans
        self.stamps = _choose_stamps(log, rig, config)
        slices, lines = _scans_of(log, rig, "slice"), _scans_of(log, rig, "line")
        self._stalls = [] if isinstance(self._track, LaserTrack) else _stalls_of(log, slices, rig, self._track)
        slices = [scan for scan in slices if not any(stall.has(scan) for stall in self._stalls)]
        self._homes = _at_home(self.stamps, [*slices, *lines])

    def __call__(self, index: int) -> Keyframe:
        """The keyframe of an index."""
        stamp, config = self.stamps[index], self._config
        observations: list[Observation] = []
        scans: list[LaserScan] = []
        beams: list[FloatArray] = []
        notes: list[str] = []
        for sensor, window in self._scans_at(index, "slice"):
            scans += window
            with _noted(stamp, config, notes):
                tracks = self._track, self._within
                observations += planes_of_window(window, stamp, sensor, *tracks, config, self._segment)
        for sensor, near in self._scans_at(index, "line"):
            scan = min(near, key=lambda one: abs(one.stamp_ns - stamp))
            scans.append(scan)
            kf_T_body = inverse(self._track.poses_at([stamp])[0]) @ self._track.poses_at([scan.stamp_ns])[0]
            at_once, lines = unswept(scan, sensor, self._within), []
            with _noted(stamp, config, notes):
                lines = lines_of_scan(at_once, sensor, kf_T_body, config.lines)
            uneven = sensor.surface_sigma_m, sensor.surface_correlation_m
            observations += [line.on_uneven_wall(*uneven) for line in lines]
            beams += beams_of(scan, usable_ranges(scan.ranges, sensor), kf_T_body @ sensor.body_T_sensor)
        return Keyframe(
            stamp,
            observations,
            self._motion(index),
            notes=tuple(notes),
            scans=tuple(scans),
            returns=np.concatenate(beams) if beams else None,
        )

    def _scans_at(self, index: int, kind: str) -> Iterator[tuple[Sensor, list[LaserScan]]]:
        """The sensors of a kind that a keyframe has scans of, with these."""
        for name, sensor in self._rig.of_kind(kind).items():
            if (index, name) in self._homes:
                yield sensor, self._homes[index, name]

    def _motion(self, index: int) -> Motion | None:
        if not index:
            return None
        ends = self.stamps[index - 1], self.stamps[index]
        if not isinstance(self._track, LaserTrack):
            motion = self._track.motion(*ends)
            stalled = [stall for stall in self._stalls if stall.overlaps(*ends)]
            seconds = 1e-9 * sum(last_ns - first_ns for first_ns, last_ns in stalled)
            return over_stalls(motion, seconds, self._config.coasting) if stalled else motion
        return motion_between(self._track, self._wheels, ends, self._config.association.new_significance)


@contextmanager
def _noted(stamp_ns: int, config: SlamConfig, notes: list[str]) -> Generator[None, None, None]:
    """Where a scan is measured: of one that cannot be used there is nothing but a note, unless the run is strict."""
    try:
        yield
    except ValueError as error:
        if config.keyframes.strict:
            raise
        notes.append(f"at {stamp_ns * 1e-9:.3f} s: {error}")


def _clouds_of(log: Log, rig: Rig, strict: bool) -> list[tuple[CloudScan, list[str]]]:
    """3D scans of the rig's sensors, each later than the one before, and with each a sentence on those after it that
    are not, and are left out. Of two scans of one time the first stays.
    """
    names, clouds = rig.of_kind("cloud"), []
    for scan in log.scans():
        if not isinstance(scan, CloudScan) or scan.sensor not in names:
            continue
        if not clouds or scan.stamp_ns > clouds[-1][0].stamp_ns:
            clouds.append((scan, []))
            continue
        problem = f"expected a scan after {clouds[-1][0].stamp_ns} ns, got {scan.stamp_ns} ns"
        if strict:
            raise LogError(log.source, problem)
        clouds[-1][1].append(f"at {scan.stamp_ns * 1e-9:.3f} s: {problem}")
    return clouds


def _choose_stamps(log: Log, rig: Rig, config: SlamConfig) -> list[int]:
    """Times of keyframes: the first scan, then whenever the odometry has gone far enough or turned enough."""
    scans = _scans_of(log, rig, "line") or _scans_of(log, rig, "slice")
    if not scans:
        raise LogError(log.source, f"expected scans of the rig's sensors ({', '.join(rig.sensors)}), found none")
    candidates = sorted({scan.stamp_ns for scan in scans})
    poses, rules = track_of(log, rig, config).poses_at(candidates), config.keyframes
    chosen = [0]
    for index in range(1, len(candidates)):
        if are_apart(poses[chosen[-1]], poses[index], rules.distance_m, rules.angle_rad):
            chosen.append(index)
    return [candidates[index] for index in chosen]


def _scans_of(log: Log, rig: Rig, kind: str) -> list[LaserScan]:
    names = rig.of_kind(kind)
    return [scan for scan in log.scans() if isinstance(scan, LaserScan) and scan.sensor in names]


#: Tracks made already, by their log: laser odometry looks at every scan.
_TRACKS: WeakKeyDictionary[Log, tuple[Rig, SlamConfig, OdometryTrack]] = WeakKeyDictionary()


def track_of(log: Log, rig: Rig, config: SlamConfig) -> OdometryTrack:
    """How the body moved, before any map: by laser odometry where there is a level laser, else by its odometry.

    Raises:
        LogError: no odometry where it is needed.
    """
    known = _TRACKS.get(log)
    if known is not None and known[0] is rig and known[1] is config:
        return known[2]
    track = laser_track(log, rig, config.coasting) or _track_of(log, rig)
    _TRACKS[log] = (rig, config, track)
    return track


def _track_of(log: Log, rig: Rig) -> OdometryTrack:
    readings = log.measured_motion
    if not readings:
        found = "got one pose all along" if log.odometry else "found none"
        raise LogError(log.source, f"expected odometry beside the scans, {found}")
    track = OdometryTrack(readings, rig.odometry)
    if track.jumps_ns:
        times = ", ".join(f"{stamp_ns * 1e-9:.3f}" for stamp_ns in track.jumps_ns[:3])
        more = f" and {len(track.jumps_ns) - 3} more" if len(track.jumps_ns) > 3 else ""
        note = f"odometry jumps at {times}{more} s: it was taken to go on there as it did before"
        if note not in log.notes:  # a log's odometry is asked for more than once
            log.notes.append(note)
    return track


def _stalls_of(log: Log, slices: Sequence[LaserScan], rig: Rig, track: OdometryTrack) -> list[Stall]:
    """Stretches that wheels did not measure, by any push-broom laser, which the log's notes tell of."""
    found = [
        stall
        for name, sensor in rig.of_kind("slice").items()
        for stall in stalls_of([scan for scan in slices if scan.sensor == name], sensor, track)
    ]
    for first_ns, last_ns in found:
        log.notes.append(
            f"wheels stand from {first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s while what is seen changes: what was "
            "seen then was left out, and the motion was measured by nobody"
        )
    return found


def _at_home(stamps: Sequence[int], scans: Sequence[LaserScan]) -> dict[tuple[int, str], list[LaserScan]]:
    """The scans of each keyframe and sensor, in time order: those it is the nearest keyframe of."""
    homes: dict[tuple[int, str], list[LaserScan]] = {}
    for scan, home in zip(scans, nearest_stamp([scan.stamp_ns for scan in scans], stamps).tolist(), strict=True):
        homes.setdefault((home, scan.sensor), []).append(scan)
    return homes
