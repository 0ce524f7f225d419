"""The odometry of a log as a track in time: poses between readings, and motions with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np

from factors import odometry_factor, planar_motion_factor, relative_pose_factor
from slam.geometry.frames import inverse
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray
from spplanes.registration import interpolate_poses

#: A robot whose odometry never leaves the floor by more than this drives on it, m and rad.
_PLANAR_TOLERANCE = 1e-9
#: Of (x, y, heading) in SP order.
PLANAR_IN_SP = (0, 1, 3)
#: Standard deviations of z, roll and pitch, m and rad, of a planar motion that says nothing of the floor.
NO_FLOOR = (1e2, 1e2, 1e2)


@dataclass(frozen=True, eq=False)
class Motion:
    """Relative motion from pose a to pose b, as odometry saw it."""

    a_T_b: FloatArray
    """Pose b in the frame of a, shape (4, 4)."""
    covariance: FloatArray
    """Planar: of (x, y, theta), additive, x and y along a's axes, shape (3, 3). Spatial: SP order, shape (6, 6)."""
    out_of_plane_sigmas: tuple[float, float, float]
    """Planar only: sigmas of (z m, roll rad, pitch rad) in this motion."""
    response: FloatArray | None = None
    """Derivative of (x, y, heading), x and y along a's axes, by the wheels' errors of calibration, scale and curvature,
    shape (3, 2); None: no wheels measured it."""
    calibration_sigmas: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of these two that `covariance` holds."""
    returns_a_T_b: FloatArray | None = None
    """Planar only: pose b by wheels and all returns together, shape (4, 4); None: no returns were matched. The lines
    are made of the same returns: what these say beyond them alone is a measurement (`information_beyond_lines`)."""
    returns_covariance: FloatArray | None = None
    """Covariance of (x, y, theta) by the returns alone, shape (3, 3)."""
    refuted_a_T_b: FloatArray | None = None
    """Planar only: pose b by wheels that the returns refute, shape (4, 4); None: they agree, or nobody measured."""

    @property
    def is_by_returns(self) -> bool:
        """Whether wheels measured nothing: the motion is that of the returns, its covariance what is known without."""
        return self.returns_a_T_b is not None and np.array_equal(self.a_T_b, self.returns_a_T_b)

    @property
    def is_measured(self) -> bool:
        """Whether wheels, right or wrong, said something."""
        return self.refuted_a_T_b is not None or not self.is_by_returns

    @property
    def scan_matched(self) -> Motion | None:
        """The motion by wheels and all returns together; None: no returns were matched."""
        if self.returns_a_T_b is None or self.returns_covariance is None:
            return None
        covariance = np.linalg.inv(np.linalg.inv(self.covariance) + np.linalg.inv(self.returns_covariance))
        return replace(self, a_T_b=self.returns_a_T_b, covariance=0.5 * (covariance + covariance.T))

    @property
    def is_planar(self) -> bool:
        """Whether the robot drives on a floor."""
        return len(self.covariance) == 3

    @property
    def spatial(self) -> FloatArray:
        """The covariance in SP order along the axes of its end, shape (6, 6)."""
        if not self.is_planar:
            return self.covariance
        return spatial_covariance(self.covariance, self.a_T_b, self.out_of_plane_sigmas)

    def factors(self, key_a: int, key_b: int) -> list[gtsam.NonlinearFactor]:
        """The motion as factors between two Pose3 keys; on a floor b is also held to the floor."""
        if not self.is_planar:
            return [relative_pose_factor(key_a, key_b, self.a_T_b, self.covariance)]
        step = odometry_factor(
            key_a,
            key_b,
            planar_delta(self.a_T_b),
            self.covariance,
            out_of_plane_sigmas=self.out_of_plane_sigmas,
        )
        floor = planar_motion_factor(key_b, sigmas=self.out_of_plane_sigmas)
        return [step, *(floor.at(i) for i in range(floor.size()))]


class OdometryTrack:
    """Odometry readings in time order, with the noise model of the wheels."""

    def __init__(self, readings: Sequence[OdometryReading], noise: OdometryNoise) -> None:
        self._stamps = np.array([reading.stamp_ns for reading in readings], dtype=np.int64)
        self._poses = np.array([reading.odom_T_body for reading in readings]).reshape(-1, 4, 4)
        self._noise = noise
        if (np.diff(self._stamps) <= 0).any():
            keep = np.concatenate(([True], np.diff(self._stamps) > 0))
            self._stamps, self._poses = self._stamps[keep], self._poses[keep]

    def __len__(self) -> int:
        return len(self._stamps)

    @cached_property
    def is_planar(self) -> bool:
        """Whether no reading leaves the floor."""
        rotations = self._poses[:, :3, :3]
        out = np.abs(self._poses[:, 2, 3]), np.abs(rotations[:, 2, :2]).max(axis=1)
        return bool(max(out[0].max(initial=0.0), out[1].max(initial=0.0)) <= _PLANAR_TOLERANCE)

    def poses_at(self, stamps_ns: Sequence[int]) -> FloatArray:
        """odom_T_body at each time, shape (N, 4, 4), interpolated; before the first and after the last it stands."""
        stamps = np.clip(np.asarray(stamps_ns, dtype=np.int64), self._stamps[0], self._stamps[-1])
        if len(self) == 1 or not len(stamps):
            return np.repeat(self._poses[:1], len(stamps), axis=0)
        first = np.searchsorted(self._stamps, stamps.min(), side="right") - 1
        last = np.searchsorted(self._stamps, stamps.max(), side="left") + 1
        near = slice(min(int(first), len(self) - 2), max(int(last), int(first) + 2))
        return interpolate_poses(self._stamps[near], self._poses[near], stamps)

    def step_covariance(self, delta: FloatArray) -> FloatArray:
        """Covariance (3, 3) of one step (x, y, theta) by the noise model of the wheels."""
        return self._noise.covariance(delta)

    def step_variances(self, deltas: FloatArray) -> FloatArray:
        """Variance of each of steps (K, 3) by the wheels' random walk alone, x, y and heading added, shape (K,)."""
        return np.trace(self._noise.random_covariances(deltas), axis1=1, axis2=2)

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """Motion between two times, its covariance accumulated over the readings between them."""
        inside = self._stamps[(self._stamps > start_ns) & (self._stamps < end_ns)]
        poses = self.poses_at([start_ns, *inside.tolist(), end_ns])
        a_T_b = inverse(poses[0]) @ poses[-1]
        noise = self._noise
        steps = np.array([planar_delta(inverse(a) @ b) for a, b in pairwise(poses)])
        _, covariance = noise.accumulate(steps)
        out_of_plane = (noise.z_sigma_m, noise.roll_sigma_rad, noise.pitch_sigma_rad)
        if self.is_planar:
            return Motion(a_T_b, covariance, out_of_plane, noise.response(steps), noise.calibration_sigmas)
        spatial = spatial_covariance(covariance, a_T_b, out_of_plane)
        return Motion(a_T_b, spatial, out_of_plane, noise.response(steps), noise.calibration_sigmas)


def planar_delta(a_T_b: FloatArray) -> FloatArray:
    """(x, y, theta) of a transform, shape (3,)."""
    return np.array([a_T_b[0, 3], a_T_b[1, 3], np.arctan2(a_T_b[1, 0], a_T_b[0, 0])])


def difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Difference of two poses (x, y, theta), of the headings by the shorter way."""
    error = a - b
    error[2] = np.remainder(error[2] + np.pi, 2.0 * np.pi) - np.pi
    return error


def spatial_covariance(
    planar: FloatArray, a_T_b: FloatArray, out_of_plane_sigmas: tuple[float, float, float]
) -> FloatArray:
    """Planar covariance and out-of-plane sigmas as one of the SP differential (x, y, z, phi, theta, psi) of a_T_b.

    The differential is composed on the right, so x and y turn from a's axes to b's.
    """
    z, roll, pitch = out_of_plane_sigmas
    additive = np.diag([0.0, 0.0, z**2, 0.0, pitch**2, roll**2])
    additive[np.ix_(PLANAR_IN_SP, PLANAR_IN_SP)] = planar
    turn = np.eye(6)
    turn[:3, :3] = a_T_b[:3, :3].T
    return turn @ additive @ turn.T


def planar_covariance(spatial: FloatArray, a_T_b: FloatArray) -> FloatArray:
    """Covariance (3, 3) of (x, y, theta) of a_T_b along a's axes, from that of its SP differential (6, 6)."""
    turn = np.eye(3)
    turn[:2, :2] = a_T_b[:2, :2]
    return turn @ spatial[np.ix_(PLANAR_IN_SP, PLANAR_IN_SP)] @ turn.T
