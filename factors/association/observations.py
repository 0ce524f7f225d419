"""What one pose saw: planes and laser lines in the body frame, behind one small interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot
from typing import Any

import gtsam
import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from factors.line import line_factor
from factors.plane import plane_factor
from spplanes import Plane, ScanLine
from spplanes._check import FloatArray, as_float_array, as_number, as_positive, as_transform, check_instance, read_only
from spplanes.outlines.extents import flatten, lift
from spplanes.spmodel import skew


@dataclass(frozen=True, eq=False)
class PlaneObservation:
    """A plane fitted in the body frame of a pose.

    Without an outline it is taken to be as large as its covariance says, which tells how far its points scatter
    whatever their noise: where neighbouring points share errors up to four times as large as it is, better give it its
    outline. One that was fitted to no points is taken to be its centre alone.
    """

    plane: Plane
    """The plane, n toward the sensor, with the covariance of sensor (and in-window motion) noise only."""
    kind: str = "plane"
    calibration_effect: FloatArray | None = None
    """What errors of its sensor's calibration do to the plane's (z, theta, psi), m and rad, shape (3, K): K independent
    ones of variance 1, the same whenever that sensor looks. They are in no covariance of the plane. None: none."""
    sensor: str = ""
    """Whose errors these are."""

    def __post_init__(self) -> None:
        check_instance("plane", self.plane, Plane)
        if self.calibration_effect is not None:
            effect = as_float_array("calibration_effect", self.calibration_effect)
            if effect.ndim != 2 or len(effect) != 3 or not effect.size or not np.isfinite(effect).all():
                raise ValueError(f"calibration_effect: expected finite numbers of shape (3, K), got {effect.shape}")
            object.__setattr__(self, "calibration_effect", read_only(effect.copy()))

    @property
    def n_points(self) -> int:
        """Number of points the plane was fitted to."""
        return self.plane.n_points

    @property
    def volume(self) -> float:
        """Root of the determinant of the covariance, rad^2 m."""
        return float(np.sqrt(np.linalg.det(self.plane.covariance)))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of its centre along the normal, m."""
        return float(np.sqrt(self.plane.covariance[0, 0]))

    @property
    def normal(self) -> FloatArray:
        """Unit normal, shape (3,)."""
        return self.plane.normal

    @property
    def vertices(self) -> FloatArray:
        """Corners of the outline in the body frame, shape (N, 3), m."""
        return lift(shapely.get_coordinates(self._outline), self.plane.frame)

    @cached_property
    def _outline(self) -> BaseGeometry:
        """The outline in (x, y) of the plane; without one the rectangle of even points that is known as well as it."""
        outline = self.plane.outline
        if outline is not None and not outline.is_empty:
            return outline
        return shapely.Polygon(_even_rectangle(self.plane)) if self.plane.n_points else shapely.Point(0.0, 0.0)

    def factor(
        self,
        pose_key: int,
        plane_key: int,
        anchor_key: int | None,
        robust: str | None = None,
        expected: gtsam.OrientedPlane3 | None = None,
    ) -> Any:
        """Full-rank plane factor."""
        return plane_factor(self.plane, pose_key, plane_key, anchor_key=anchor_key, robust=robust)

    def full_plane(self, tilt_sigma_rad: float) -> Plane:
        """The plane itself: nothing is left open."""
        return self.plane

    def patch_in(self, plane_T_body: FloatArray) -> BaseGeometry:
        """The outline, or the rectangle in its place."""
        return flatten(self._outline, as_transform("plane_T_body", plane_T_body) @ self.plane.frame)


def _even_rectangle(plane: Plane) -> FloatArray:
    """Corners, shape (4, 2), m, in (x, y) of a plane, of the rectangle whose points, spread evenly, tell as much of it.

    Points of independent errors tell a tilt by their variance across the axis times what they tell the height by; the
    variance of a rectangle is a third of its half side squared.
    """
    information = np.linalg.inv(plane.covariance)
    weight = information[0, 0]
    middle = np.array((-information[0, 1], information[0, 2])) / weight
    signs = np.array((-1.0, 1.0))
    variances, axes = np.linalg.eigh(information[1:, 1:] * np.outer(signs, signs) / weight - np.outer(middle, middle))
    sides = axes * np.sqrt(3.0 * np.maximum(variances, 0.0))
    return middle + np.array(((-1, -1), (1, -1), (1, 1), (-1, 1))) @ sides.T


@dataclass(frozen=True, eq=False)
class LineObservation:
    """A line seen by a 2D laser: rank-2 information on a plane."""

    line: ScanLine
    """The line in the sensor's scan plane."""
    body_T_sensor: FloatArray
    """Mount of the laser, a (4, 4) matrix or a ``gtsam.Pose3``."""
    kind: str = "line"

    def __post_init__(self) -> None:
        check_instance("line", self.line, ScanLine)
        mount = as_transform("body_T_sensor", self.body_T_sensor)
        object.__setattr__(self, "body_T_sensor", read_only(mount.copy()))

    @property
    def n_points(self) -> int:
        """Number of beams on the line."""
        return len(self.line.indices)

    @cached_property
    def volume(self) -> float:
        """Root of the determinant of the covariance, rad m."""
        return float(np.sqrt(np.linalg.det(self.line.covariance)))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of its middle along the normal, m."""
        return float(np.sqrt(self._covariance_at_middle[0, 0]))

    @cached_property
    def normal(self) -> FloatArray:
        """Normal of the plane through the line and square to the scan plane, toward the sensor, shape (3,)."""
        return read_only(-self.body_T_sensor[:3, :2] @ np.array([np.cos(self.line.alpha), np.sin(self.line.alpha)]))

    @cached_property
    def vertices(self) -> FloatArray:
        """The two ends in the body frame, shape (2, 3), m."""
        return read_only(lift(self.line.endpoints, self.body_T_sensor))

    def factor(
        self,
        pose_key: int,
        plane_key: int,
        anchor_key: int | None,
        robust: str | None = None,
        expected: gtsam.OrientedPlane3 | None = None,
    ) -> Any:
        """Rank-2 line factor; native, and so faster, where the landmark is known to cut the scan plane."""
        if expected is not None:
            # a weight that depends on the expected direction is only as good as that: not for planes near the scan's
            cut = hypot(*(expected.normal().point3() @ self.body_T_sensor[:3, :2]).tolist())
            expected = expected if cut >= 0.5 else None
        return line_factor(
            self.line,
            self.body_T_sensor,
            pose_key,
            plane_key,
            anchor_key=anchor_key,
            expected=expected,
            robust=robust,
        )

    def full_plane(self, tilt_sigma_rad: float) -> Plane:
        """The plane through the line and square to the scan plane; its tilt about the line is a stated assumption.

        Frame: x along the line, y along the scan plane's normal. A rotation about x (psi) tilts the plane about the
        line, which the laser does not see; z and theta are the line's own two numbers.
        """
        covariance, of_line = np.zeros((3, 3)), self._covariance_at_middle
        covariance[:2, :2] = 0.5 * (of_line + of_line.T)
        covariance[2, 2] = as_number("tilt_sigma_rad", tilt_sigma_rad) ** 2
        return Plane._trusted(self._frame, covariance, self.n_points)  # asked for several times a line and keyframe

    def on_uneven_wall(self, sigma_m: float, correlation_m: float) -> LineObservation:
        """The line with the error of a wall that is not straight, which the beams of one patch of it share.

        Of the L / correlation patches of a line each is off by `sigma_m`: its middle by sigma^2 / patches, its
        direction by 12 / L^2 times that. What the line's covariance already holds of it, as if every beam were off by
        itself, is less.

        Args:
            sigma_m: standard deviation of the wall about a straight one, m; 0: it is straight.
            correlation_m: length of a patch, m.

        Raises:
            ValueError: a sigma that is none, a length that is not positive.
        """
        line, sigma_m = self.line, as_number("sigma_m", sigma_m)
        if sigma_m < 0.0:
            raise ValueError(f"sigma_m: expected no less than 0, got {sigma_m}")
        patches = max(line.length / as_positive("correlation_m", correlation_m), 1.0)
        shift = sigma_m**2 * max(1.0 / patches - 1.0 / self.n_points, 0.0)
        if shift == 0.0 or line.length == 0.0:
            return self
        middle = float(line.endpoints.mean(axis=0) @ line.direction)
        jacobian = np.array(((1.0, 0.0), (middle, 1.0)))
        extra = jacobian @ np.diag((12.0 * shift / line.length**2, shift)) @ jacobian.T
        return replace(self, line=replace(line, covariance=line.covariance + extra))

    @cached_property
    def _frame(self) -> FloatArray:
        """Of `full_plane`."""
        x_axis = skew(self.body_T_sensor[:3, 2]) @ self.normal
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack((x_axis, self.body_T_sensor[:3, 2], self.normal))
        frame[:3, 3] = self.vertices.mean(axis=0)
        return frame

    @cached_property
    def _covariance_at_middle(self) -> FloatArray:
        """Of (z, theta): shift along the plane's normal at the segment's middle, rotation about the frame's y."""
        return self.line.covariance_at(float(self.line.endpoints.mean(axis=0) @ self.line.direction))

    def patch_in(self, plane_T_body: FloatArray) -> BaseGeometry:
        """The segment."""
        ends = lift(self.vertices, as_transform("plane_T_body", plane_T_body))[:, :2]
        return shapely.LineString(ends) if np.ptp(ends, axis=0).max() > 0.0 else shapely.Point(ends[0])


#: A measurement of a plane landmark.
Observation = PlaneObservation | LineObservation


def as_observation(name: str, value: object) -> Observation:
    """An observation, or the one that a plane in the body frame is. ValueError: it is neither."""
    if isinstance(value, Plane):
        return PlaneObservation(value)
    if not isinstance(value, Observation):
        kind = type(value).__name__
        raise ValueError(f"{name}: expected a Plane, a PlaneObservation or a LineObservation, got {kind}")
    return value


def planes_of(observations: Sequence[Observation]) -> list[Plane]:
    """Those that are planes, in the body frame, in their order."""
    return [observation.plane for observation in observations if isinstance(observation, PlaneObservation)]
