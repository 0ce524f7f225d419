"""What returns say of a motion counts once: by the lines that are matched, and beyond them by the motion itself."""

import numpy as np
import pytest

from factors.association.observations import LineObservation
from slam import Keyframe, PlaneSlam
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import motion_covariance
from slam.frontend.information import inverted
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from spplanes import ScanLine
from spplanes._check import FloatArray

#: Standard deviations of (x, y, heading) by wheels and by returns, and of a line: direction rad, shift m.
WHEELS, RETURNS = np.array([0.1, 0.1, 0.05]), np.array([0.01, 0.01, 0.004])
LINE = np.array([0.002, 0.005])


def wall(ahead: float, side: float) -> LineObservation:
    """A wall of 3 m across the way, its middle so far ahead and so far to the left."""
    ends, turn = np.array([[ahead, side - 1.5], [ahead, side + 1.5]]), np.array([[1.0, 0.0], [side, 1.0]])
    line = ScanLine(0.0, ahead, turn @ np.diag(LINE**2) @ turn.T, ends, np.arange(40))
    return LineObservation(line, np.eye(4))


def after_a_step(first: list[LineObservation], second: list[LineObservation]) -> FloatArray:
    """Information of (x, y, theta) of half a metre ahead, by wheels, returns and lines, shape (3, 3)."""
    step, told = planar_transform(0.5, 0.0, 0.0), np.diag(RETURNS**2)
    motion = Motion(step, np.diag(WHEELS**2), (1e-3, 1e-3, 1e-3), returns_a_T_b=step, returns_covariance=told)
    slam = PlaneSlam()
    slam.add_keyframe(Keyframe(0, first))
    slam.add_keyframe(Keyframe(1, second, motion))
    keys = [pose_symbol(0), pose_symbol(1)]
    a_T_b = inverse(slam.backend.pose(keys[0])) @ slam.backend.pose(keys[1])
    return inverted(motion_covariance(a_T_b, slam.backend.joint_covariance(keys).of(keys)))


BY_ALL = np.diag(WHEELS**-2.0 + RETURNS**-2.0)


@pytest.mark.parametrize("seen", [[], [wall(4.0, 8.0)]], ids=["no lines", "a line of a wall that nobody knows"])
def test_returns_count_in_full_where_no_line_was_matched(seen: list[LineObservation]) -> None:
    np.testing.assert_allclose(after_a_step([wall(6.0, 0.0)], seen), BY_ALL, rtol=0.02, atol=1e-6)


def test_a_matched_line_takes_its_share_of_what_the_returns_say() -> None:
    told = after_a_step([wall(6.0, 0.0)], [wall(5.5, 0.0)])
    twice = LINE[1] ** -2.0 / 2.0  # seen from both ends
    once = WHEELS[0] ** -2.0 + max(RETURNS[0] ** -2.0, twice)
    assert told[0, 0] == pytest.approx(once, rel=0.05)  # counted twice it would be half as much again
    assert told[0, 0] > WHEELS[0] ** -2.0 + 0.5 * twice  # the line itself counts
    assert told[1, 1] == pytest.approx(BY_ALL[1, 1], rel=0.05)  # along the wall the returns speak alone
