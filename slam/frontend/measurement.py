"""Measurement of a keyframe: planes of a 3D scan or a push-broom window, lines of a 2D scan, as observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from shapely import Polygon

from factors.association.observations import LineObservation, PlaneObservation
from slam.config import SlamConfig
from slam.frontend.deskewing import Sweeps, middle_ns, place_beams
from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.frontend.scan_regions import (
    Regions,
    believed_planes,
    members_of,
    on_planes,
    relabelled,
    unambiguous,
    well_conditioned,
)
from slam.frontend.scan_surfaces import surfaces_of
from slam.geometry.frames import inverse
from slam.geometry.polygons import coarse, flatten, largest_polygon
from slam.io.clouds.cloud import grid_of
from slam.sensors.log import CloudScan, LaserScan
from slam.sensors.rig import Sensor
from slam.sensors.scan_noise import line_tilt_covariances, model_of, surface_covariances
from spplanes import LineConfig, MapperConfig, Plane, extract_lines, fit_plane
from spplanes._check import FloatArray, as_float_array
from spplanes.clouds.arrange import are_linked, arrange
from spplanes.clouds.turn import TurnBegin
from spplanes.registration import RegisteredScans, beam_directions, register_scans
from spplanes.segmentation.config import ValidationConfig
from spplanes.segmentation.planes import frames_of, moments_of, outlines_in, planes_of
from spplanes.segmentation.scans import Labelled, label_scans
from spplanes.segmentation.validation.one_plane import is_one_plane
from spplanes.segmentation.validation.plane_ends import Window, sure_points
from spplanes.segmentation.validation.splitting import purified, tells_tilt


def window_poses(stamps_ns: Sequence[int], keyframe_ns: int, track: OdometryTrack) -> tuple[FloatArray, FloatArray]:
    """Poses of the body at several times, in the body frame at the keyframe.

    Returns:
        kf_T_body (S, 4, 4), and the joint covariance (6 S, 6 S) of their errors, each in the SP order
        (x, y, z, phi, theta, psi), composed on the world side: rotations about the keyframe's origin.

    Odometry is a random walk: the error of a scan is the sum of the errors of all steps between it and the keyframe.
    On the world side a step's error is the same for every scan beyond it, so the covariance of two scans on the same
    side of the keyframe is that of the nearer one, and scans on different sides are independent.
    """
    poses = track.poses_at([keyframe_ns, *stamps_ns])
    relative = inverse(poses[0]) @ poses[1:]
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    count = len(stamps)
    joint = np.zeros((count, 6, count, 6))
    for side in (stamps < keyframe_ns, stamps >= keyframe_ns):
        members = np.flatnonzero(side)
        outward = members[np.argsort(np.abs(stamps[members] - keyframe_ns), kind="stable")]
        walked = [np.zeros((6, 6))]  # on the world side, after each step away from the keyframe
        steps = [(keyframe_ns, np.eye(4)), *zip(stamps[outward].tolist(), relative[outward], strict=True)]
        for (start_ns, start), (end_ns, end) in pairwise(steps):
            base, tip = (start, end) if end_ns > start_ns else (end, start)
            step = track.noise.covariance(planar_delta(inverse(base) @ tip))
            walked.append(walked[-1] + _step_covariance(base, tip, step))
        number = np.arange(1, len(outward) + 1)
        joint[outward[:, None], :, outward] = np.array(walked)[np.minimum.outer(number, number)]
    return relative, joint.reshape(6 * count, 6 * count)


def _step_covariance(base: FloatArray, tip: FloatArray, planar: FloatArray) -> FloatArray:
    """A step's covariance of (x, y, theta), additive in the axes of `base`, as that of a world-side perturbation.

    Translation acts along base's axes; the rotation turns everything beyond about the step's end, so about the origin
    it also shifts by -theta z x tip. Its sign, which depends on the direction of the walk, cancels in the covariance.
    """
    lever = np.cross([0.0, 0.0, 1.0], tip[:3, 3])
    jacobian = np.zeros((6, 3))
    jacobian[:3, :2] = base[:3, :2]
    jacobian[:3, 2] = -lever
    jacobian[3, 2] = 1.0
    return jacobian @ planar @ jacobian.T


class Segment(Protocol):
    """Segmentation as the measurement of keyframes calls it; `label_scans` unless it is given another."""

    def __call__(
        self,
        points: FloatArray,
        covariances: FloatArray,
        /,
        *,
        config: MapperConfig,
        viewpoints: FloatArray | None = None,
        pose_covariances: FloatArray | None = None,
    ) -> Labelled:
        """Regions of a grid of points (S, B, 3) with covariances (S, B, 3, 3)."""


@dataclass(frozen=True, eq=False)
class ScanMeasurement:
    """What a 3D scan saw, in the body frame."""

    observations: list[PlaneObservation] = field(default_factory=list)
    """Its planes, each facing the sensor, largest first."""
    surfaces: FloatArray | None = None
    """All its returns, thinned, as surface elements, shape (N, 9); see `surfaces_of`. None: it has no returns."""


def planes_of_cloud(
    scan: CloudScan, sensor: Sensor, config: SlamConfig, sweeps: Sweeps | None = None
) -> list[PlaneObservation]:
    """Planes of one 3D scan in the body frame, each facing the sensor, largest first."""
    return measured_cloud(scan, sensor, config, sweeps=sweeps).observations


def measured_cloud(
    scan: CloudScan,
    sensor: Sensor,
    config: SlamConfig,
    segment: Segment = label_scans,
    sweeps: Sweeps | None = None,
) -> ScanMeasurement:
    """Planes of one 3D scan, and all its returns as surface elements.

    Where the rig knows of rough surfaces, what is on no plane is searched again for planes as flat as those. During the
    turn of a sensor that takes time over it the body moved by `sweeps`, where that is known.
    """
    points = as_float_array("points", scan.points)  # once: a stored cloud is read each time
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise ValueError(f"points: expected shape (S, B, 3) or (N, 3), got {points.shape}")
    points = usable_points(points, sensor)
    if not np.isfinite(points).any():
        return ScanMeasurement()
    begin = None
    if sensor.sweep_s > 0.0 and sweeps is not None:
        begin = _begin_of(scan, sensor)
        points = sweeps.unswept(points, sensor, scan.stamp_ns, begin)
    points = in_rows(points, sensor)
    planes, labels = _flat_planes(points, sensor, config, segment)
    if sensor.rough_sigma_m > sensor.surface_sigma_m:
        rough = sensor.model_copy(update={"surface_sigma_m": sensor.rough_sigma_m})
        free = np.where((labels == -1)[..., None], points, np.nan)
        more, rough_labels = _flat_planes(free, rough, config, segment, servo=False)
        labels = np.where(rough_labels >= 0, rough_labels + len(planes), labels)
        planes += more
    hesse = np.array([(*plane.normal, plane.d) for plane in planes]).reshape(-1, 4)
    if begin is not None and sweeps is not None:
        members = members_of(labels, len(planes))
        seen = zip(planes, (points.reshape(-1, 3)[some] for some in members), strict=True)
        planes = [sweeps.blurred(plane, some, sensor, begin) for plane, some in seen]
    observations = [_seen_by(sensor, scan.sensor, plane) for plane in planes]
    observations = sorted(observations, key=lambda seen: -seen.n_points)
    return ScanMeasurement(observations, surfaces_of(points, labels, hesse, sensor))


def _seen_by(sensor: Sensor, name: str, plane: Plane) -> PlaneObservation:
    """A plane in a sensor's frame as an observation of the body, with what the sensor's calibration leaves open."""
    seen = plane.transform(sensor.body_T_sensor)
    if sensor.warp is None or not np.any(sensor.warp.left_open):
        return PlaneObservation(seen)
    return PlaneObservation(seen, calibration_effect=sensor.warp.effect_on(plane.frame), sensor=name)


def _begin_of(scan: CloudScan, sensor: Sensor) -> TurnBegin:
    """Where the turn of a sensor that spins began, by the order of its points or as the rig has it."""
    return scan.begin or TurnBegin(np.deg2rad(sensor.sweep_start_deg), sensor.sweep_clockwise)


def loose_surfaces(scan: CloudScan, sensor: Sensor) -> FloatArray:
    """Surface elements (N, 9) of a 3D scan as its points come, none of them laid on a plane; see `surfaces_of`."""
    points = in_rows(usable_points(scan.points, sensor), sensor)
    return surfaces_of(points, np.full(points.shape[:2], -1), np.empty((0, 4)), sensor)


def in_rows(points: FloatArray, sensor: Sensor) -> FloatArray:
    """Points of a scan, (N, 3) or (S, B, 3), as a grid with neighbours in a row, shape (S, B, 3); NaN = no return.

    A scan without order is seen as lines or a range image, as wide as the rig says, or as its points suggest; so is a
    grid that is mostly holes, as its points suggest.
    """
    if points.ndim == 2:
        return arrange(points, grid_of(sensor))
    return points if are_linked(np.isfinite(points[..., 0])) else arrange(points.reshape(-1, 3))


def _flat_planes(
    points: FloatArray, sensor: Sensor, config: SlamConfig, segment: Segment, *, servo: bool = True
) -> tuple[list[Plane], np.ndarray]:
    """Planes of points (S, B, 3), in the sensor's frame, and the plane of every point, shape (S, B).

    -1: of none; -2: of a region that is no plane. With `servo` the search grants them the servo's error. Rough surfaces
    are granted enough: both would swallow what is beside them.
    """
    covariances, settings = model_of(sensor).covariances(points), for_points(for_sensor(config.mapper, sensor), points)
    viewpoint = np.zeros(3)
    tilts = line_tilt_covariances(sensor, len(points)) if servo else None
    found = segment(points, covariances, config=settings, viewpoints=viewpoint, pose_covariances=tilts)
    rows = moments_of(found.points, found.covariance, found.labels, settings)
    rough, spreads = frames_of(rows, np.zeros((len(rows), 3)))
    regions = Regions(points, covariances, found.labels, rough, sensor, viewpoint, settings, config.measurements)
    sure = well_conditioned(on_planes(unambiguous(regions)))
    believed = believed_planes(sure)
    labels, region = relabelled(regions, sure.labels, believed)
    extents = np.sqrt(spreads[:, 1:] / rows[:, 1:2])
    flat = [one.plane for planes in believed for one in planes]
    frames = np.array([plane.frame for plane in flat]).reshape(-1, 4, 4)
    outlines = outlines_in(frames, points, np.maximum(labels, -1), extents[region], settings)
    planes = [_with_outline(plane, outline) for plane, outline in zip(flat, coarse(outlines), strict=True)]
    # the error that all points of a scan's plane share, whatever their number
    shared = np.diag([sensor.plane_sigma_m**2, sensor.plane_sigma_rad**2, sensor.plane_sigma_rad**2])
    if shared.any():
        planes = [replace(plane, covariance=plane.covariance + shared) for plane in planes]
    return planes, labels


def planes_of_window(
    scans: Sequence[LaserScan],
    stamp_ns: int,
    sensor: Sensor,
    track: OdometryTrack,
    sweeps: OdometryTrack,
    config: SlamConfig,
    segment: Segment,
) -> list[PlaneObservation]:
    """Planes of a push-broom window in the body frame at `stamp_ns`.

    The scans are placed by odometry. Its error inside the window is shared by all points of a scan and grows along the
    window, so it goes into the fit as one joint covariance of the scan poses, never into the points' own. A scan that
    takes time has each beam where the body was at its moment by `sweeps`; it errs with the pose of its middle.
    """
    if len(scans) < 2:
        return []
    kf_T_body, pose_covariance = window_poses([middle_ns(scan, sensor) for scan in scans], stamp_ns, track)
    ranges, mount = np.stack([usable_ranges(scan.ranges, sensor) for scan in scans]), sensor.body_T_sensor
    placed = register_scans(ranges, scans[0].angles, kf_T_body, model_of(sensor), body_T_sensor=mount)
    placed = place_beams(placed, scans, kf_T_body, sensor, sweeps)
    mapper = for_sensor(config.mapper, sensor)
    found = segment(placed.points, placed.covariances, config=mapper, viewpoints=placed.viewpoints)
    labels = found.labels.astype(np.int32)
    planes = planes_of(found.points, found.covariance, found.labels, found.views, found.poses, mapper)
    uneven = sensor.surface_sigma_m
    labels, planes = purified(placed, labels, planes, pose_covariance, uneven, mapper, config.measurements)
    window, frames = Window(placed.points, placed.covariances, pose_covariance), [plane.frame for plane in planes]
    sure = np.where(sure_points(window, labels, frames, mapper.flatness_m), labels, -1)
    max_tilt_rad = mapper.for_rows(len(scans)).max_tilt_rad
    observations = []
    for plane, members in zip(planes, members_of(sure, len(planes)), strict=True):
        if tells_tilt(window, members, plane.frame, max_tilt_rad):
            observations += _in_window(plane, members, placed, pose_covariance, sensor, config.measurements)
    return sorted(observations, key=lambda seen: -seen.n_points)


def _in_window(
    plane: Plane,
    members: np.ndarray,
    placed: RegisteredScans,
    pose_covariance: FloatArray,
    sensor: Sensor,
    rules: ValidationConfig,
) -> list[PlaneObservation]:
    """The plane fitted anew to some of a window's points, with the poses' joint covariance; none: they are not one."""
    scan_index = members // placed.points.shape[1]
    points, viewpoint = placed.points.reshape(-1, 3)[members], placed.viewpoints[scan_index].mean(axis=0)
    noise = surface_covariances(points, placed.covariances.reshape(-1, 3, 3)[members], plane.frame, sensor)
    told = {"viewpoint": viewpoint, "scan_index": scan_index, "pose_covariances": pose_covariance}
    try:
        fitted = fit_plane(points, noise, shared_error=False, **told)
    except ValueError:  # one bad patch must not end a run
        return []
    if not is_one_plane(fitted, points, noise, viewpoint, rules, scan_index):
        return []
    if plane.outline is not None:
        fitted = _with_outline(fitted, largest_polygon(flatten(plane.outline, inverse(fitted.frame) @ plane.frame)))
    return [PlaneObservation(fitted)]


def _with_outline(plane: Plane, outline: Polygon | None) -> Plane:
    return Plane._trusted(plane.frame, plane.covariance, plane.n_points, outline, plane.chi2)


def lines_of_scan(scan: LaserScan, sensor: Sensor, kf_T_body: FloatArray, config: LineConfig) -> list[LineObservation]:
    """Lines of one 2D scan, with the mount as the keyframe's body sees it."""
    ranges = usable_ranges(scan.ranges, sensor)
    # what the sensor errs by is in the rig, from all of the log: one scan tells less
    lines = extract_lines(ranges, scan.angles, sigma=sensor.beam_sigma_m, config=config, shared_error=False)
    return [LineObservation(line, kf_T_body @ sensor.body_T_sensor) for line in lines]


def for_sensor(config: MapperConfig, sensor: Sensor) -> MapperConfig:
    """The segmentation's settings with the flatness that the sensor's systematic error leaves to be seen.

    Half of it: inside a region, which is fitted to the error, less of it is left than between regions. A servo's error
    goes into the segmentation as that of the lines' poses, alike in half of what errs as one block.
    """
    config = replace(config, flatness_m=max(config.flatness_m, 0.5 * sensor.surface_sigma_m))
    tilts = sensor.tilt_sigma_rad > 0.0
    return replace(config, pose_correlation_scans=0.5 * sensor.tilt_correlation_lines) if tilts else config


def for_points(config: MapperConfig, points: FloatArray) -> MapperConfig:
    """The segmentation's settings with outlines as fine as points (S, B, 3) let them be.

    Their cells are half as wide as what usually lies between points of neighbouring rows, up to twice what is asked.
    """
    steps = np.linalg.norm(np.diff(points[:, ::8], axis=0), axis=-1)  # some columns tell
    steps = steps[np.isfinite(steps)]
    apart = float(np.median(steps)) if len(steps) else 0.0
    return replace(config, outline_cell_m=min(max(0.5 * apart, config.outline_cell_m), 2.0 * config.outline_cell_m))


def usable_ranges(ranges: FloatArray, sensor: Sensor) -> FloatArray:
    """Ranges (B,) with NaN for what lies outside the sensor's limits."""
    with np.errstate(invalid="ignore"):
        inside = (ranges > sensor.range_min_m) & (ranges < sensor.range_max_m)
    return np.where(inside, ranges, np.nan)


def usable_points(points: FloatArray, sensor: Sensor) -> FloatArray:
    """Points (..., 3) in the sensor frame without its warp, NaN for what lies outside the sensor's limits."""
    points = as_float_array("points", points)
    if points.shape[-1:] != (3,):
        raise ValueError(f"points: expected shape (..., 3), got {points.shape}")
    if sensor.warp is not None and points.ndim == 3:
        points = sensor.warp.taken_off(points)
    with np.errstate(over="ignore"):  # what is that far is left out
        ranges = usable_ranges(np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + points[..., 2] ** 2), sensor)
    return np.where(np.isfinite(ranges)[..., None], points, np.nan)


def returns_of(scan: LaserScan | CloudScan, sensor: Sensor, sweeps: Sweeps | None = None) -> FloatArray:
    """What a scan met within the reach of its sensor, in the sensor's frame, shape (N, 3), m; of a 3D sensor that takes
    time over a turn as of its stamp, if the body moved by `sweeps`.
    """
    if isinstance(scan, CloudScan):
        points = usable_points(np.asarray(scan.points, dtype=np.float64), sensor).reshape(-1, 3)
        if sensor.sweep_s > 0.0 and sweeps is not None:
            points = sweeps.unswept(points, sensor, scan.stamp_ns, _begin_of(scan, sensor))
    else:
        points = usable_ranges(scan.ranges, sensor)[:, None] * beam_directions(scan.angles)
    return points[np.isfinite(points).all(axis=1)]
