"""The odometry of a log as a track in time: poses between readings, and motions with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from factors import planar_motion_factor, relative_pose_factor
from factors._conventions import POSE3_TO_SP, planar_motion
from slam.geometry.frames import inverse
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray
from spplanes.registration import interpolate_poses

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

    def erring(self, square: FloatArray) -> Motion:
        """The same, erring by so much more: mean square in SP order along the axes of its end, shape (6, 6)."""
        more = planar_covariance(square, self.a_T_b) if self.is_planar else square
        return replace(self, covariance=self.covariance + more)

    def factors(self, key_a: int, key_b: int) -> list[gtsam.NonlinearFactor]:
        """The motion as factors between two Pose3 keys; on a floor b is also held to the floor."""
        return [self.factor(key_a, key_b), *self.floor_factors(key_b)]

    def factor(self, key_a: int, key_b: int) -> gtsam.BetweenFactorPose3:
        """The motion alone as a factor between two Pose3 keys."""
        if not self.is_planar:
            return relative_pose_factor(key_a, key_b, self.a_T_b, self.covariance)
        # what `factors.odometry_factor` would check was checked when the motion came: it is asked for at every step
        motion, covariance = planar_motion(planar_delta(self.a_T_b), self.covariance, self.out_of_plane_sigmas)
        return gtsam.BetweenFactorPose3(key_a, key_b, motion, gtsam.noiseModel.Gaussian.Covariance(covariance))

    def floor_factors(self, key_b: int) -> list[gtsam.NonlinearFactor]:
        """What holds its end to the floor; of a motion that is not planar nothing does."""
        if not self.is_planar:
            return []
        floor = planar_motion_factor(key_b, sigmas=self.out_of_plane_sigmas)
        return [floor.at(i) for i in range(floor.size())]


class OdometryTrack:
    """Odometry readings in time order, with the noise model of the wheels.

    Where they jump (begin anew, say, or are set to another place) the body is taken to have gone on as before, which is
    as uncertain as it changed its motion from one reading to the next.
    """

    def __init__(self, readings: Sequence[OdometryReading], noise: OdometryNoise, *, can_jump: bool = True) -> None:
        """Poses that were held against scans already cannot jump: those were seen."""
        self._stamps = np.array([reading.stamp_ns for reading in readings], dtype=np.int64)
        self._poses = np.array([reading.odom_T_body for reading in readings]).reshape(-1, 4, 4)
        self.noise = noise
        later = np.diff(self._stamps, prepend=self._stamps[:1] - 1) > 0
        self._stamps, self._poses = self._stamps[later], self._poses[later]
        self._jumps = _jumps(self._stamps, self._poses) if can_jump else np.zeros(0, dtype=np.int64)
        self._poses, self._change = _continued(self._stamps, self._poses, self._jumps)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def readings(self) -> list[OdometryReading]:
        """Each later than the one before, and without jumps."""
        return [OdometryReading(int(t), pose) for t, pose in zip(self._stamps, self._poses, strict=True)]

    @property
    def jumps_ns(self) -> list[int]:
        """Times of the first readings after a jump, ns."""
        return self._stamps[self._jumps + 1].tolist()

    def onward(self, stamps_ns: Sequence[int]) -> FloatArray:
        """As `poses_at`, but before the first reading and after the last the body goes on as it did beside it."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        inside = np.clip(stamps, self._stamps[0], self._stamps[-1])
        there, back = self.poses_at(inside.tolist()), self.poses_at((2 * inside - stamps).tolist())
        off = (inside != stamps)[:, None, None]
        return np.where(off, there @ np.linalg.inv(back) @ there, there)

    @cached_property
    def is_planar(self) -> bool:
        """Whether no reading leaves the floor, in height or by a lean, m and rad."""
        return bool(np.abs(self._poses[:, 2, [0, 1, 3]]).max(initial=0.0) <= 1e-9)

    def poses_at(self, stamps_ns: Sequence[int]) -> FloatArray:
        """odom_T_body at each time, shape (N, 4, 4), interpolated; before the first and after the last it stands."""
        stamps = np.clip(np.asarray(stamps_ns, dtype=np.int64), self._stamps[0], self._stamps[-1])
        if len(self) == 1 or not len(stamps):
            return np.repeat(self._poses[:1], len(stamps), axis=0)
        first = np.searchsorted(self._stamps, stamps.min(), side="right") - 1
        last = np.searchsorted(self._stamps, stamps.max(), side="left") + 1
        near = slice(min(int(first), len(self) - 2), max(int(last), int(first) + 2))
        return interpolate_poses(self._stamps[near], self._poses[near], stamps)

    def step_variances(self, deltas: FloatArray) -> FloatArray:
        """Variance of each of steps (K, 3) by the wheels' random walk alone, x, y and heading added, shape (K,)."""
        return np.trace(self.noise.random_covariances(deltas), axis1=1, axis2=2)

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """Motion between two times, its covariance accumulated over the readings between them."""
        inside = self._stamps[(self._stamps > start_ns) & (self._stamps < end_ns)]
        poses = self.poses_at([start_ns, *inside.tolist(), end_ns])
        a_T_b = inverse(poses[0]) @ poses[-1]
        noise = self.noise
        steps = np.array([planar_delta(inverse(a) @ b) for a, b in pairwise(poses)])
        _, covariance = noise.accumulate(steps)
        out_of_plane = (noise.z_sigma_m, noise.roll_sigma_rad, noise.pitch_sigma_rad)
        if not self.is_planar:
            covariance = spatial_covariance(covariance, a_T_b, out_of_plane)
        motion = Motion(a_T_b, covariance, out_of_plane, noise.response(steps), noise.calibration_sigmas)
        for jump in self._jumps[(self._stamps[self._jumps] < end_ns) & (self._stamps[self._jumps + 1] > start_ns)]:
            carried = gtsam.Pose3(inverse(poses[-1]) @ self._poses[jump + 1]).AdjointMap()
            more = carried @ self._change @ carried.T
            motion = motion.erring(more[np.ix_(POSE3_TO_SP, POSE3_TO_SP)])
        return motion


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


def _jumps(stamps_ns: np.ndarray, poses: FloatArray) -> np.ndarray:
    """Which of the steps between readings are none that the body made, by their first readings, (J,).

    Those ten times as fast, in distance or in turning, as the ones beside them, for a robot that starts goes on, and as
    all of the drive but the fastest hundredth: of five real robots' 37,000 steps none is 7 times as fast.
    """
    if len(stamps_ns) <= 20:  # nobody can tell how fast they are as a rule
        return np.zeros(0, dtype=np.int64)
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    turns = Rotation.from_matrix(steps[:, :3, :3]).magnitude()
    sizes = np.stack((np.linalg.norm(steps[:, :3, 3], axis=1), turns))
    speeds = sizes / _paces(stamps_ns)
    fast = np.sort(speeds, axis=1)[:, -1 - max(1, int(0.01 * len(steps)))]
    beside = np.maximum(np.pad(speeds[:, :-1], ((0, 0), (1, 0))), np.pad(speeds[:, 1:], ((0, 0), (0, 1))))
    alone = speeds > 10.0 * np.maximum(beside, fast[:, None])
    return np.flatnonzero((alone & (sizes > 0.05)).any(axis=0))  # no jump is as short, m or rad


def _continued(stamps_ns: np.ndarray, poses: FloatArray, jumps: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Poses (N, 4, 4) without the jumps: for each the step before it, or after it, once more.

    And the covariance of such a step: how much steps differ from the one before, GTSAM order, (6, 6).
    """
    if not len(jumps):
        return poses, np.zeros((6, 6))
    twists = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(inverse(a) @ b)) for a, b in pairwise(poses)])
    continued, pace = poses.copy(), _paces(stamps_ns)
    for jump in jumps.tolist():
        like = jump - 1 if jump else jump + 1
        step = gtsam.Pose3.Expmap(twists[like] * (pace[jump] / pace[like])).matrix()
        after = continued[jump] @ step @ inverse(continued[jump + 1])
        continued[jump + 1 :] = after @ continued[jump + 1 :]
    changes = np.diff(np.delete(twists, jumps, axis=0), axis=0)
    return continued, np.diag(np.mean(changes**2, axis=0))


def _paces(stamps_ns: np.ndarray) -> FloatArray:
    """Seconds that steps between readings took, shape (N - 1,): clocks jitter, and two may be at nearly one time."""
    times = np.diff(stamps_ns) * 1e-9
    return np.maximum(times, np.median(times))
