"""The robot as rig.yaml describes it: sensors, mounts and the noise models every stage works from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from slam._yaml import Finite, Frozen, NotNegative, Positive
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray, as_transform
from spplanes.spmodel import transform_from_rpy

#: Rows of weights, one for each wave down the image, of as many waves across it.
Waves = tuple[tuple[Finite, ...], ...]
Vector3 = tuple[Finite, Finite, Finite]


class RangeWarp(Frozen):
    """By what share ranges are too long, as sums of cosines over the image.

    At row v and column u of an image of H by W pixels the share is a(v, u) + b(v, u) r for the range r, with
    a = sum_ij shares[i][j] cos(pi i (v + 1/2) / H) cos(pi j (u + 1/2) / W), and b alike.

    References:
        Herrera, Kannala, Heikkila, "Joint depth and color camera calibration with distortion correction", TPAMI 2012.
        Teichman, Miller, Thrun, "Unsupervised intrinsic calibration of depth sensors via SLAM", RSS 2013.
    """

    shares: Waves
    """Weights of the waves of a, of one."""
    shares_per_m: Waves
    """Of those of b, which grow with the range, 1/m; as many."""
    left_open: tuple[Vector3, Vector3, Vector3] = ((0.0, 0.0, 0.0),) * 3
    """Covariance (3, 3) of a vector g: by the share g . u ranges along unit rays u, in the camera's frame, may still be
    too long. It is the same at all times, so it does not average out: all poses and planes have it."""

    @model_validator(mode="after")
    def _check_shape(self) -> RangeWarp:
        if len(self.shares) != len(self.shares_per_m):
            raise ValueError("expected as many rows of shares_per_m as of shares")
        if len({len(row) for row in (*self.shares, *self.shares_per_m)}) != 1:
            raise ValueError("expected rows of one length")
        left = np.array(self.left_open)
        if not np.allclose(left, left.T) or np.linalg.eigvalsh(left)[0] < -1e-9 * np.trace(left):
            raise ValueError("expected a covariance as left_open: symmetric, and of no negative variance")
        return self

    def over(self, height: int, width: int) -> FloatArray:
        """a and b over an image, shape (2, H, W)."""
        weights = np.array((self.shares, self.shares_per_m), dtype=np.float64)
        down, across = waves(height, weights.shape[1]), waves(width, weights.shape[2])
        return np.asarray(down @ weights @ across.T, dtype=np.float64)

    def taken_off(self, points: FloatArray) -> FloatArray:
        """Points (H, W, 3) of an image, in the camera's frame, with true ranges."""
        share, per_m = self.over(*points.shape[:2])
        ranges = np.sqrt(np.einsum("hwi,hwi->hw", points, points))
        return points / (1.0 + share + per_m * ranges)[..., None]

    def effect_on(self, plane: FloatArray) -> FloatArray:
        """What is left open does to a plane in the camera's frame, its own frame (4, 4), centre where it was seen.

        Three independent errors of variance 1 to its (z, theta, psi), shape (3, 3): seen along the ray u at a distance
        r, a point of it is off along the normal n by (n . p) (g . u).
        """
        x, y, normal, centre = plane[:3, 0], plane[:3, 1], plane[:3, 2], plane[:3, 3]
        far = float(np.linalg.norm(centre))
        ray, off = centre / far, float(normal @ centre)
        slopes = off / far * (np.stack((x, y)) - np.outer((x @ ray, y @ ray), ray))
        values, vectors = np.linalg.eigh(np.array(self.left_open))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(np.stack((off * ray, -slopes[0], slopes[1])) @ root, dtype=np.float64)


def waves(size: int, count: int) -> FloatArray:
    """The first cosines over so many pixels, shape (size, count)."""
    return np.cos(np.pi / size * np.outer(np.arange(size) + 0.5, np.arange(count)))


class Mount(Frozen):
    """Where a sensor sits: body_T_sensor as position and roll, pitch, yaw, or as a 4x4 matrix, never both.

    R = Rz(yaw) Ry(pitch) Rx(roll). The body frame is x forward, y left, z up, its origin on the floor.
    """

    xyz_m: Vector3 = (0.0, 0.0, 0.0)
    """Position of the sensor in the body frame, m."""
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the sensor in the body frame, deg."""
    matrix: tuple[tuple[Finite, ...], ...] | None = None
    """The whole (4, 4) transform, in place of xyz_m and rpy_deg."""

    @model_validator(mode="before")
    @classmethod
    def _from_rows(cls, value: Any) -> Any:
        return {"matrix": value} if isinstance(value, (list, tuple)) else value

    @model_validator(mode="after")
    def _check_matrix(self) -> Mount:
        if self.matrix is not None:
            if {"xyz_m", "rpy_deg"} & self.model_fields_set:
                raise ValueError("expected xyz_m and rpy_deg or a 4x4 matrix, got both")
            as_transform("body_T_sensor", [list(row) for row in self.matrix])
        return self

    @model_serializer(mode="wrap")
    def _as_rows(self, write: SerializerFunctionWrapHandler) -> Any:
        return self.matrix or write(self)

    @classmethod
    def of(cls, body_T_sensor: FloatArray) -> Mount:
        """The mount of a transform, shape (4, 4)."""
        return cls(matrix=tuple(map(tuple, body_T_sensor.tolist())))

    def as_matrix(self) -> FloatArray:
        """body_T_sensor, shape (4, 4)."""
        if self.matrix is not None:
            return np.array(self.matrix, dtype=np.float64)
        transform = transform_from_rpy((*self.xyz_m, *np.deg2rad(self.rpy_deg)[::-1]))
        rotation = transform[:3, :3]
        rotation[np.abs(rotation) < 1e-15] = 0.0  # at quarter turns
        return transform


class Sensor(Frozen):
    """One range sensor: what it is used for, where it sits, how it errs."""

    kind: Literal["line", "slice", "cloud"]
    """line: 2D laser whose scans give lines; slice: push-broom 2D laser whose scans assemble into 3D; cloud: 3D."""
    mount: Mount = Field(default=Mount(), alias="body_T_sensor")
    """Pose of the sensor in the body frame; the key in the file is body_T_sensor."""
    record: str | None = None
    """Name of its records in a log, such as FLASER or ROBOTLASER1, or its topic in a bag; None: the sensor's name."""
    first_angle_deg: Finite | None = None
    """Bearing of the first beam, deg; None: as the log says."""
    angle_step_deg: Finite | None = None
    """Bearing between neighbouring beams, deg; None: as the log says."""
    rows: Annotated[int, Field(ge=2)] | None = None
    """Rings of a 3D sensor whose points come without order: rows of its range image; None: found in the points."""
    columns: Annotated[int, Field(ge=2)] | None = None
    """Steps of azimuth in a whole turn of such a sensor; given with rows or not at all."""
    range_sigma_m: Positive
    """Standard deviation of a range along the beam, m."""
    disparity_sigma_per_m: NotNegative = 0.0
    """Part of the ranges' noise that grows with their square, m per m^2, as that of cameras, which measure an angle
    from two places; added in variance."""
    disparity_step_per_m: NotNegative = 0.0
    """Step of such ranges, m per m^2: a whole number of a camera's pixels; its variance is step^2 / 12; 0: none."""
    bearing_sigma_rad: NotNegative = 0.0
    """Standard deviation of a bearing, rad."""
    quantisation_m: NotNegative = 0.0
    """Step of the ranges, m; 0: none. Its variance, step^2 / 12, is part of `range_variance_m2`."""
    range_max_m: Positive
    """Ranges at or beyond this are no returns, m."""
    sweep_s: NotNegative = 0.0
    """Time from the first beam of a 2D scan to the last, s; a scan's stamp is that of its first beam. Of a 3D sensor
    that turns: time of a turn, in whose middle it is stamped; 0: nothing moved meanwhile, or it was compensated."""
    sweep_start_deg: Finite = -180.0
    """Azimuth about the sensor's z at which such a turn begins, deg, where the order of its points does not say."""
    sweep_clockwise: bool = False
    """Whether the sensor turns clockwise, seen from above, likewise."""
    surface_sigma_m: NotNegative = 0.0
    """Systematic floor: flatness of real walls and range bias that averaging over beams does not remove, m."""
    surface_correlation_m: Positive = 0.3
    """Size of the patch of a surface whose points share one such error, m."""
    rough_sigma_m: NotNegative = 0.0
    """The same of rough surfaces, such as window fronts: what is on no plane of a 3D scan is searched again for planes
    that are only as flat as this, m; 0: it is not."""
    tilt_sigma_rad: NotNegative = 0.0
    """Error of the angle of a tilting scanner's servo (rotation about the sensor's y), rad; the beams of one line of
    the scan share it."""
    tilt_correlation_lines: Positive = 20.0
    """Number of neighbouring lines of a tilting scanner that share one such error."""
    plane_sigma_m: NotNegative = 0.0
    """Systematic error of every plane of a 3D scan that no number of points averages away: along its normal, m."""
    plane_sigma_rad: NotNegative = 0.0
    """The same of its tilt, about each axis in the plane, rad: angles of a turned laser, motion within a scan."""
    range_min_m: NotNegative = 0.0
    """Ranges below this are the robot itself, or too near to be measured, m."""
    warp: RangeWarp | None = None
    """By what share ranges of a camera are too long, over its image: taken off. None: what its images show is."""

    @model_validator(mode="after")
    def _check_shape(self) -> Sensor:
        if (self.rows is None) != (self.columns is None):
            raise ValueError("expected rows and columns, got one of the two")
        return self

    @property
    def body_T_sensor(self) -> FloatArray:
        """Pose of the sensor in the body frame, shape (4, 4)."""
        return self.mount.as_matrix()

    def beam_times_ns(self, stamp_ns: int, n_beams: int) -> np.ndarray:
        """Time of each beam of a 2D scan, evenly spread over the sweep, shape (B,), int64."""
        steps = np.arange(n_beams) * (self.sweep_s * 1e9 / max(n_beams - 1, 1))
        return stamp_ns + np.round(steps).astype(np.int64)

    @property
    def range_variance_m2(self) -> float:
        """Variance of one range, noise and quantisation together, m^2."""
        return self.range_sigma_m**2 + self.quantisation_m**2 / 12.0

    @property
    def beam_sigma_m(self) -> float:
        """Standard deviation of a beam of a 2D laser about a wall: range, quantisation and unevenness together, m."""
        return float(np.sqrt(self.range_variance_m2 + self.surface_sigma_m**2))

    def range_variance_at(self, ranges: FloatArray) -> FloatArray:
        """Variance of ranges, what grows with them included, m^2, of their shape."""
        growing = self.disparity_sigma_per_m**2 + self.disparity_step_per_m**2 / 12.0
        return self.range_variance_m2 + growing * np.square(np.square(ranges))


class LocalisationNoise(Frozen):
    """Error of the poses a log gives (poses-given mapping): stationary, Gaussian, correlated along the path.

    Each of x, y and heading is an Ornstein-Uhlenbeck process of the path length: covariance sigma^2 exp(-ds / length).
    """

    xy_sigma_m: NotNegative = 0.003
    """Standard deviation of x and of y in the world, m."""
    heading_sigma_rad: NotNegative = 0.0005
    """Standard deviation of the heading, about the body's own origin, rad."""
    z_sigma_m: NotNegative = 0.0
    """Standard deviation of the height, m; 0: a robot on a floor."""
    tilt_sigma_rad: NotNegative = 0.0
    """Standard deviation of the rotation about x and of that about y, rad; 0: a robot on a floor."""
    correlation_length_m: Positive = 2.0
    """Path length over which the correlation falls to 1/e, m."""

    def covariance(self) -> FloatArray:
        """Covariance of the error (x, y, heading) of one pose, shape (3, 3)."""
        return np.diag([self.xy_sigma_m**2, self.xy_sigma_m**2, self.heading_sigma_rad**2])

    def location_covariance(self) -> FloatArray:
        """The same in the order (x, y, z, phi, theta, psi), shape (6, 6), rotation about the body's own origin."""
        xy, tilt = self.xy_sigma_m**2, self.tilt_sigma_rad**2
        return np.diag([xy, xy, self.z_sigma_m**2, self.heading_sigma_rad**2, tilt, tilt])


class Rig(Frozen):
    """Everything about the robot that the data do not say themselves."""

    sensors: Annotated[dict[str, Sensor], Field(min_length=1)]
    """Sensors by name; at least one."""
    odometry_record: str | None = None
    """Topic of the odometry in a bag; None: that which comes most often."""
    odometry_frame: str | None = None
    """Frame of a bag that tf tells the odometry from, in place of a topic; None: odom or the like."""
    body_frame: str | None = None
    """Frame of a bag that is the body; None: the child frame of the odometry, else base_link or the like."""
    odometry: OdometryNoise = OdometryNoise()
    """Noise model of the wheel odometry."""
    localisation: LocalisationNoise | None = None
    """Noise model of the poses given in the log; None: the log's poses are not for mapping."""

    @model_validator(mode="after")
    def _one_odometry(self) -> Rig:
        if self.odometry_record is not None and self.odometry_frame is not None:
            raise ValueError("odometry_frame: expected one source of odometry, got odometry_record too")
        return self

    def of_kind(self, kind: str) -> dict[str, Sensor]:
        """The sensors of one kind, by name."""
        return {name: sensor for name, sensor in self.sensors.items() if sensor.kind == kind}

    def name_of_record(self, record: str) -> str | None:
        """Name of the sensor whose records carry this name in a log; None: the rig does not have it."""
        return next((name for name, s in self.sensors.items() if (s.record or name) == record), None)

    def to_plain(self) -> dict[str, Any]:
        """The rig as `from_yaml` and `model_validate` take it, out of what YAML and JSON have."""
        return self.model_dump(mode="json", by_alias=True, exclude_none=True)

    def to_yaml(self, path: Path | str) -> None:
        """Write the rig so that `from_yaml` reads the same rig."""
        text = yaml.safe_dump(self.to_plain(), sort_keys=False, default_flow_style=None, allow_unicode=True)
        Path(path).write_text(text, encoding="utf-8")
