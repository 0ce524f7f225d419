"""The noise model of wheel odometry: drift per metre and per radian, and the covariance of a relative motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from slam._yaml import Frozen, NotNegative, Positive
from spplanes._check import FloatArray, as_shape
from spplanes._jit import inlined, njit


class OdometryNoise(Frozen):
    """What wheels do wrong: a random walk, and an error of calibration that stays the same.

    Of the random walk the variances (not the standard deviations) grow with the way driven and the angle turned, so a
    relative motion has the same covariance however often odometry was read on the way. The calibration errors, scale
    and curvature, are the same on the whole way: their standard deviations grow with it.

    An error is additive on a relative motion (x, y, theta), with x and y in the frame of its first pose.
    """

    along_sigma_m_per_sqrt_m: NotNegative = 0.02
    """Random: standard deviation along the motion after 1 m, m."""
    lateral_sigma_m_per_sqrt_m: NotNegative = 0.01
    """Random: across the motion after 1 m, m; what the heading error adds comes on top of it."""
    heading_sigma_rad_per_sqrt_m: NotNegative = 0.0087
    """Random: of the heading after 1 m (0.5 deg), rad."""
    heading_sigma_rad_per_sqrt_rad: NotNegative = 0.02
    """Random: of the heading after a turn of 1 rad, rad."""
    slip_sigma_m_per_sqrt_rad: NotNegative = 0.005
    """Random: of x and of y after a turn of 1 rad, m."""
    scale_sigma: NotNegative = 0.0
    """Calibration: of the length of every way, as a share of it."""
    curvature_sigma_rad_per_m: NotNegative = 0.0
    """Calibration: of the heading per metre, rad."""
    floor_m: Positive = 1e-4
    """Standard deviation that even a motion of nothing has, m; keeps the covariance invertible."""
    floor_rad: Positive = 1e-5
    """The same of the heading, rad."""
    z_sigma_m: Positive = 1e-3
    """Out of plane: standard deviation of the height between two keyframes, m."""
    pitch_sigma_rad: Positive = 1e-3
    """Out of plane: standard deviation of the rotation about y (theta) between two keyframes, rad."""
    roll_sigma_rad: Positive = 1e-3
    """Out of plane: standard deviation of the rotation about x (psi) between two keyframes, rad."""

    def covariance(self, delta: ArrayLike) -> FloatArray:
        """Covariance of one relative motion `delta` (x, y, theta), shape (3, 3), m^2, m rad, rad^2.

        The turn is taken as spread evenly over a straight way L, so a heading variance q leaves q L^2 / 3 across it
        and q L / 2 in the cross term, a curvature c leaves c L^2 / 2 across it.
        """
        return self.accumulate([as_shape("delta", delta, (3,))])[1]

    def accumulate(self, deltas: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Compose motions (K, 3) one after another: the whole motion (3,) and its covariance (3, 3), first order."""
        steps = as_shape("deltas", deltas, (None, 3))
        total, covariance, response = _compose(steps, self.random_covariances(steps))
        systematic = np.diag([self.scale_sigma**2, self.curvature_sigma_rad_per_m**2])
        floor = np.diag([self.floor_m**2, self.floor_m**2, self.floor_rad**2])
        return total, covariance + response @ systematic @ response.T + floor

    @property
    def calibration_sigmas(self) -> tuple[float, float]:
        """Standard deviations of scale and of curvature, 1 and rad/m."""
        return self.scale_sigma, self.curvature_sigma_rad_per_m

    def response(self, deltas: ArrayLike) -> FloatArray:
        """Derivative of the whole of motions (K, 3) by scale and curvature, shape (3, 2)."""
        steps = as_shape("deltas", deltas, (None, 3))
        return _compose(steps, np.zeros((len(steps), 3, 3)))[2]

    def random_covariances(self, deltas: ArrayLike) -> FloatArray:
        """Covariances (K, 3, 3) of the random walk alone over motions (K, 3), without floor and calibration errors."""
        sigmas = (
            self.along_sigma_m_per_sqrt_m,
            self.lateral_sigma_m_per_sqrt_m,
            self.heading_sigma_rad_per_sqrt_m,
            self.heading_sigma_rad_per_sqrt_rad,
            self.slip_sigma_m_per_sqrt_rad,
        )
        return _random_covariances(as_shape("deltas", deltas, (None, 3)), np.array(sigmas) ** 2)


#: What to expect of the wheels of a robot nobody describes. From the 909 steps of the Intel Research Lab log against
#: its corrected poses: heading drifts by -3.9 deg per metre driven straight and lengths are 4 % off (calibration); the
#: rest scatters by 1.2 deg in a metre driven straight and by 1.4 deg in a turn of 0.54 rad (robust deviations); turns
#: on the spot shift x and y by 0.04 and 0.07 m after 1 rad (root mean square).
UNCALIBRATED_WHEELS = OdometryNoise(
    along_sigma_m_per_sqrt_m=0.03,
    lateral_sigma_m_per_sqrt_m=0.03,
    heading_sigma_rad_per_sqrt_m=0.03,
    heading_sigma_rad_per_sqrt_rad=0.04,
    slip_sigma_m_per_sqrt_rad=0.07,
    scale_sigma=0.04,
    curvature_sigma_rad_per_m=0.07,
    floor_m=1e-3,
    floor_rad=1e-3,
)


@njit(cache=True)
def _random_covariances(deltas, variances):
    """Covariance of the random walk over each motion; variances: along, lateral, heading by way, by turn, slip."""
    covariances = np.zeros((len(deltas), 3, 3))
    for k in range(len(deltas)):
        dx, dy = deltas[k, 0], deltas[k, 1]
        way, turn = np.sqrt(dx * dx + dy * dy), abs(deltas[k, 2])
        heading = variances[2] * way + variances[3] * turn
        slip = variances[4] * turn
        along = variances[0] * way + slip
        across = variances[1] * way + slip + heading * way**2 / 3.0
        c, s = (dx / way, dy / way) if way > 0.0 else (1.0, 0.0)
        covariance = covariances[k]
        covariance[0, 0] = c * c * along + s * s * across
        covariance[1, 1] = s * s * along + c * c * across
        covariance[0, 1] = covariance[1, 0] = c * s * (along - across)
        covariance[0, 2] = covariance[2, 0] = -s * heading * way / 2.0
        covariance[1, 2] = covariance[2, 1] = c * heading * way / 2.0
        covariance[2, 2] = heading
    return covariances


@njit(cache=True)
def _compose(deltas, covariances):
    """Whole motion (3,), its covariance (3, 3), and its derivative (3, 2) by scale and curvature."""
    total, covariance, response = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 2))
    turned, carried = np.zeros((3, 3)), np.empty((3, 3))
    for k in range(len(deltas)):
        c, s = np.cos(total[2]), np.sin(total[2])
        dx, dy = deltas[k, 0], deltas[k, 1]
        way = np.sqrt(dx * dx + dy * dy)
        x, y = c * dx - s * dy, s * dx + c * dy
        _conjugate(covariance, 1.0, 0.0, -y, x, carried)
        _conjugate(covariances[k], c, s, 0.0, 0.0, turned)
        for a in range(3):
            for b in range(3):
                covariance[a, b] = carried[a, b] + turned[a, b]
        bend_x, bend_y = -dy * way / 2.0, dx * way / 2.0
        response[0, 0] += -y * response[2, 0] + x
        response[1, 0] += x * response[2, 0] + y
        response[0, 1] += -y * response[2, 1] + c * bend_x - s * bend_y
        response[1, 1] += x * response[2, 1] + s * bend_x + c * bend_y
        response[2, 1] += way
        total[0], total[1], total[2] = total[0] + x, total[1] + y, total[2] + deltas[k, 2]
    return total, covariance, response


@inlined
def _conjugate(covariance, c, s, x, y, result):
    """Write T C T^T, shape (3, 3), of T = ((c, -s, x), (s, c, y), (0, 0, 1))."""
    rows = ((c, -s, x), (s, c, y), (0.0, 0.0, 1.0))
    for a in range(3):
        u = rows[a]
        for b in range(3):
            v, total = rows[b], 0.0
            for m in range(3):
                total += u[m] * (covariance[m, 0] * v[0] + covariance[m, 1] * v[1] + covariance[m, 2] * v[2])
            result[a, b] = total
