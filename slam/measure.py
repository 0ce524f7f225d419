"""From raw scans to observations: planes of a 3D scan or a push-broom window, lines of a 2D scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam._patch_kernels import numbered, patches_of, with_shared, within
from slam.config import SlamConfig
from slam.frames import inverse
from slam.goodness import is_one_plane
from slam.io.arrange import arrange, grid_of
from slam.io.log import CloudScan, LaserScan
from slam.observations import LineObservation, PlaneObservation
from slam.odometry import OdometryTrack
from slam.outlines import coarse, flatten
from slam.rig import Sensor
from slam.sweep import middle_ns, place_beams
from slam.window import window_poses
from spplanes import LineConfig, MapperConfig, Plane, extract_lines, fit_plane, fit_planes, segment_scans
from spplanes._check import FloatArray
from spplanes.noise import SensorModel
from spplanes.registration import register_scans


def planes_of_cloud(scan: CloudScan, sensor: Sensor, config: SlamConfig) -> list[PlaneObservation]:
    """Planes of one 3D scan in the body frame, each facing the sensor, largest first.

    A scan without order is seen as lines or a range image first, as wide as the rig says, or as its points suggest.
    Where the rig knows of rough surfaces, what is on no plane is searched again for planes as flat as those.
    """
    points = scan.points  # once: a stored cloud is read each time
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise ValueError(f"points: expected shape (S, B, 3) or (N, 3), got {points.shape}")
    points = usable_points(points, sensor)
    if not np.isfinite(points).any():
        return []
    if points.ndim == 2:
        points = arrange(points, grid_of(sensor))
    observations, free = _flat_planes(points, sensor, config)
    if sensor.rough_sigma_m > sensor.surface_sigma_m:
        rough = sensor.model_copy(update={"surface_sigma_m": sensor.rough_sigma_m})
        observations += _flat_planes(np.where(free[..., None], points, np.nan), rough, config, servo=False)[0]
    return sorted(observations, key=lambda seen: -seen.n_points)


def _flat_planes(
    points: FloatArray, sensor: Sensor, config: SlamConfig, *, servo: bool = True
) -> tuple[list[PlaneObservation], np.ndarray]:
    """Planes of points (S, B, 3), in the body frame, and which points are on none, shape (S, B).

    With `servo` the search grants them the servo's error. Rough surfaces are granted enough: both would swallow what
    is beside them.
    """
    covariances = model_of(sensor).covariances(points)
    viewpoint = np.zeros(3)
    labels, planes = segment_scans(
        points,
        covariances,
        config=for_sensor(config.mapper, sensor),
        viewpoints=viewpoint,
        pose_covariances=line_tilt_covariances(sensor, len(points)) if servo else None,
    )
    parts, noises, blurred = [], [], []
    for plane, members in zip(planes, members_of(labels, len(planes)), strict=True):
        part = points.reshape(-1, 3)[members]
        noise = surface_covariances(part, covariances.reshape(-1, 3, 3)[members], plane, sensor)
        parts.append(part)
        noises.append(noise)
        blurred.append(servo_covariances(part, noise, members // labels.shape[1], sensor))
    observations = []
    for part, noise, refitted in zip(parts, noises, _refit_all(parts, blurred, planes, viewpoint), strict=True):
        if refitted is None:
            continue
        drift = tilt_drift(refitted, part, sensor) if sensor.tilt_sigma_rad > 0.0 else None
        if is_one_plane(refitted, part, noise, viewpoint, config.measurements, drift_m=drift):
            observations.append(PlaneObservation(_in_scan(refitted, sensor).transform(sensor.body_T_sensor)))
    return observations, labels < 0


def members_of(labels: np.ndarray, count: int) -> list[np.ndarray]:
    """Indices into the flat grid of the points of every plane, ascending, from labels (S, B)."""
    order, flat = np.argsort(labels, axis=None, kind="stable"), labels.ravel()
    return np.split(order, np.searchsorted(flat[order], np.arange(count + 1)))[1:-1]


def planes_of_window(
    scans: Sequence[LaserScan], stamp_ns: int, sensor: Sensor, track: OdometryTrack, config: SlamConfig
) -> list[PlaneObservation]:
    """Planes of a push-broom window in the body frame at `stamp_ns`.

    The scans are placed by odometry. Its error inside the window is shared by all points of a scan and grows along the
    window, so it goes into the fit as one joint covariance of the scan poses, never into the points' own. A scan that
    takes time has each beam where the body was at its moment; it errs with the pose of its middle.
    """
    if len(scans) < 2:
        return []
    kf_T_body, pose_covariance = window_poses([middle_ns(scan, sensor) for scan in scans], stamp_ns, track)
    ranges, model = np.stack([usable_ranges(scan.ranges, sensor) for scan in scans]), model_of(sensor)
    placed = register_scans(ranges, scans[0].angles, kf_T_body, model, body_T_sensor=sensor.body_T_sensor)
    placed = place_beams(placed, scans, kf_T_body, sensor, track, model)
    labels, planes = segment_scans(
        placed.points,
        placed.covariances,
        config=for_sensor(config.mapper, sensor),
        viewpoints=placed.viewpoints,
    )
    observations = []
    for plane, members in zip(planes, members_of(labels, len(planes)), strict=True):
        scan_index = members // labels.shape[1]
        points, viewpoint = placed.points.reshape(-1, 3)[members], placed.viewpoints[scan_index].mean(axis=0)
        noise = surface_covariances(points, placed.covariances.reshape(-1, 3, 3)[members], plane, sensor)
        refitted = _refit(
            points, noise, plane, viewpoint=viewpoint, scan_index=scan_index, pose_covariances=pose_covariance
        )
        if refitted is None:
            continue
        if is_one_plane(refitted, points, noise, viewpoint, config.measurements, scan_index):
            observations.append(PlaneObservation(refitted))
    return sorted(observations, key=lambda seen: -seen.n_points)


def lines_of_scan(scan: LaserScan, sensor: Sensor, kf_T_body: FloatArray, config: LineConfig) -> list[LineObservation]:
    """Lines of one 2D scan, with the mount as the keyframe's body sees it."""
    sigma = float(np.sqrt(sensor.range_variance_m2 + sensor.surface_sigma_m**2))
    lines = extract_lines(usable_ranges(scan.ranges, sensor), scan.angles, sigma=sigma, config=config)
    return [LineObservation(line, kf_T_body @ sensor.body_T_sensor) for line in lines]


def model_of(sensor: Sensor) -> SensorModel:
    """Errors of the sensor's beams."""
    return SensorModel(
        range_sigma_m=sensor.range_sigma_m,
        bearing_sigma_rad=sensor.bearing_sigma_rad,
        quantisation_m=sensor.quantisation_m,
    )


def for_sensor(config: MapperConfig, sensor: Sensor) -> MapperConfig:
    """The segmentation's settings with the flatness that the sensor's systematic error leaves to be seen.

    Half of it: inside a region, which is fitted to the error, less of it is left than between regions. A servo's error
    goes into the segmentation as that of the lines' poses, alike in half of what errs as one block.
    """
    flatness = max(config.flatness_m, 0.5 * sensor.surface_sigma_m)
    if sensor.tilt_sigma_rad == 0.0:
        return replace(config, flatness_m=flatness)
    return replace(config, flatness_m=flatness, pose_correlation_scans=0.5 * sensor.tilt_correlation_lines)


def usable_ranges(ranges: FloatArray, sensor: Sensor) -> FloatArray:
    """Ranges (B,) with NaN for what lies outside the sensor's limits."""
    with np.errstate(invalid="ignore"):
        inside = (ranges > sensor.range_min_m) & (ranges < sensor.range_max_m)
    return np.where(inside, ranges, np.nan)


def usable_points(points: FloatArray, sensor: Sensor) -> FloatArray:
    """Points (..., 3) in the sensor frame with NaN for what lies outside the sensor's limits."""
    flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    return within(flat, sensor.range_min_m, sensor.range_max_m).reshape(points.shape)


def surface_covariances(points: FloatArray, covariances: FloatArray, plane: Plane, sensor: Sensor) -> FloatArray:
    """Covariances (N, 3, 3) of a plane's points that also carry the surface's own error, which neighbours share.

    The surface is cut into square patches of the correlation length; the points of one patch share an error of
    `surface_sigma_m` along the normal. n points that share it say as much as n points with n times its variance each,
    so a patch seen by many beams counts no more than its surface allows.
    """
    if sensor.surface_sigma_m == 0.0:
        return covariances
    row, column, n_rows, n_columns = patches_of(points, plane.frame, sensor.surface_correlation_m)
    patch, count = numbered(row * n_columns + column, n_rows * n_columns)
    return with_shared(covariances, patch, count, plane.normal[None], sensor.surface_sigma_m**2)


def line_tilt_covariances(sensor: Sensor, n_lines: int) -> FloatArray | None:
    """Covariances (S, 6, 6) of the errors (x, y, z, phi, theta, psi) of a tilting scanner's lines; None: none."""
    if sensor.tilt_sigma_rad == 0.0:
        return None
    return np.tile(np.diag([0.0, 0.0, 0.0, 0.0, sensor.tilt_sigma_rad**2, 0.0]), (n_lines, 1, 1))


def servo_covariances(points: FloatArray, covariances: FloatArray, line: np.ndarray, sensor: Sensor) -> FloatArray:
    """Covariances (N, 3, 3) of a plane's points (N, 3) that also carry the servo's error, which lines (N,) share.

    The lines are taken in blocks of `tilt_correlation_lines` that err alike, each block on its own. As with surfaces, n
    points that share an error say as much as n points with n times its variance each.
    """
    if sensor.tilt_sigma_rad == 0.0:
        return covariances
    block = (line / sensor.tilt_correlation_lines).astype(np.int64)
    return with_shared(covariances, block, int(block.max(initial=0)) + 1, _lever(points), sensor.tilt_sigma_rad**2)


def tilt_drift(plane: Plane, points: FloatArray, sensor: Sensor) -> FloatArray:
    """Standard deviation of the shift along the plane's normal that the servo's error gives points (N, 3), (N,), m."""
    return sensor.tilt_sigma_rad * np.abs(_lever(points) @ plane.normal)


def _lever(points: FloatArray) -> FloatArray:
    """How points (N, 3) move when the servo turns them about y, m per rad, shape (N, 3)."""
    return np.stack((points[:, 2], np.zeros(len(points)), -points[:, 0]), axis=1)


def _refit_all(
    points: Sequence[FloatArray], covariances: Sequence[FloatArray], planes: Sequence[Plane], viewpoint: FloatArray
) -> list[Plane | None]:
    """`_refit` of many planes at once, where all can be fitted."""
    if not planes:
        return []
    planes = [plane if plane.outline is None else replace(plane, outline=coarse(plane.outline)) for plane in planes]
    labels = np.repeat(np.arange(len(planes)), [len(part) for part in points])
    try:
        fits = fit_planes(np.concatenate(points), np.concatenate(covariances), labels, viewpoint=viewpoint)
    except ValueError:
        parts = zip(points, covariances, planes, strict=True)
        return [_refit(part, noise, plane, viewpoint=viewpoint) for part, noise, plane in parts]
    return [_outlined(fitted, plane) for fitted, plane in zip(fits, planes, strict=True)]


def _in_scan(plane: Plane, sensor: Sensor) -> Plane:
    """The plane with the error that all points of a scan's plane share, whatever their number."""
    shared = np.diag([sensor.plane_sigma_m**2, sensor.plane_sigma_rad**2, sensor.plane_sigma_rad**2])
    return replace(plane, covariance=plane.covariance + shared) if shared.any() else plane


def _refit(points: FloatArray, covariances: FloatArray, plane: Plane, **fit: np.ndarray) -> Plane | None:
    """The plane with everything the sensor is known to err in, and the outline that was found for it.

    None where the points, errors counted, no longer determine a plane: one bad patch must not end a run.
    """
    try:
        fitted = fit_plane(points, covariances, **fit)  # type: ignore[arg-type]
    except ValueError:
        return None
    return _outlined(fitted, plane)


def _outlined(fitted: Plane, plane: Plane) -> Plane:
    """A plane fitted anew with the outline of what it was before."""
    if plane.outline is None:
        return fitted
    return replace(fitted, outline=flatten(plane.outline, inverse(fitted.frame) @ plane.frame))
