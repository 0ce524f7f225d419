"""Odometry that was found wrong errs where nothing tells, as often as it was found; what would tell makes it right."""

from dataclasses import replace

import numpy as np
import pytest

from slam.config import CoastingConfig
from slam.frontend.odometry import Motion
from slam.geometry.frames import planar_transform
from slam.tracking.odometry_check import Check
from slam.tracking.odometry_record import OdometryRecord
from slam.tracking.prediction import coast

STILL = Motion(np.eye(4), np.diag([1e-4, 1e-4, 1e-5]) ** 2, (1e-3, 1e-3, 1e-3))
GUESS = coast(None, 0.0, 0.5, CoastingConfig())
SHARP, NOWHERE = np.diag(np.repeat([0.02, 0.005], 3) ** 2), np.diag([9.0, 4e-4, 4e-4, 2e-5, 2e-5, 2e-5])
AHEAD = planar_transform(0.25, 0.0, 0.0)


def record_of(wrong: int, fine: int, expected: np.ndarray = AHEAD) -> OdometryRecord:
    """So many steps that were spoken against, 25 cm off, and so many that were not though they would have been."""
    record, guess = OdometryRecord(0.001), replace(GUESS, a_T_b=expected)
    for k in range(wrong):
        record.take(k + 1, STILL, guess, GUESS, Check(True, SHARP))
        record.settle(AHEAD)
    for k in range(fine):
        record.take(wrong + k + 1, STILL, guess, GUESS, Check(False, SHARP))
        record.settle(np.eye(4))
    return record


def test_odometry_that_nothing_spoke_against_is_used_as_stated() -> None:
    record = record_of(0, 5)
    assert record.take(6, STILL, GUESS, GUESS, Check(False, NOWHERE)) is STILL
    assert record.take(7, STILL, GUESS, GUESS, Check(False)) is STILL and record.believed() == []


def test_where_errors_would_have_been_told_it_is_used_as_stated_and_elsewhere_it_errs() -> None:
    record = record_of(9, 27, expected=planar_transform(-0.25, 0.0, 0.0))  # expected worse than measured
    assert record.take(40, STILL, GUESS, GUESS, Check(False, SHARP)) is STILL
    erring = record.take(41, STILL, GUESS, GUESS, Check(False, NOWHERE))
    assert erring.is_planar
    assert erring.covariance[0, 0] == pytest.approx(1e-8 + 9 / (9 + 27) * 0.25**2)  # found in 9 of 36 steps that tell
    np.testing.assert_allclose(erring.covariance[1:, 1:], STILL.covariance[1:, 1:], atol=1e-12)
    assert [one.used for one in record.steps[-2:]] == ["as stated", "erring"]


def test_errors_are_along_the_axes_of_the_end_and_covariances_of_motions_of_the_start() -> None:
    record = record_of(5, 0, expected=planar_transform(-0.25, 0.0, 0.0))
    erring = record.take(6, replace(STILL, a_T_b=planar_transform(0.0, 0.0, np.pi / 2)), GUESS, GUESS, Check(False))
    assert erring.covariance[1, 1] == pytest.approx(0.25**2, rel=1e-4)
    assert erring.covariance[0, 0] == pytest.approx(1e-8, rel=1e-3)


def test_an_assumption_that_was_nearer_takes_the_place_of_odometry_that_stands_still() -> None:
    record, expected = record_of(5, 0), replace(GUESS, a_T_b=AHEAD)
    assert record.again and record.take(6, STILL, expected, GUESS, Check(False)) is expected
    assert record.take(7, STILL, expected, GUESS, Check(True)) is expected and not record_of(0, 1).again


def test_an_assumption_that_is_nearer_only_where_wheels_slip_takes_no_place_of_odometry() -> None:
    """A body that turned goes on turning by constant velocity: of the other steps odometry knew better."""
    record, expected = record_of(3, 9), replace(GUESS, a_T_b=AHEAD)
    assert record.take(13, STILL, expected, GUESS, Check(False, NOWHERE)).a_T_b is STILL.a_T_b
    assert record.take(14, STILL, expected, GUESS, Check(True)) is expected
    assert [step.used for step in record.steps[-2:]] == ["erring", "not"]


def test_steps_believed_before_the_odometry_was_found_wrong_are_known() -> None:
    record = OdometryRecord(0.001)
    for k, place in enumerate((NOWHERE, SHARP, None)):
        record.take(k + 1, STILL, GUESS, GUESS, Check(False, place))
    record.take(4, STILL, GUESS, GUESS, Check(True, SHARP))
    record.settle(AHEAD)
    assert [keyframe for keyframe, _ in record.believed()] == [1, 3]


def test_errors_of_the_heading_widen_the_heading() -> None:
    record, turned = OdometryRecord(0.001), planar_transform(0.0, 0.0, 0.1)
    expected = replace(GUESS, a_T_b=planar_transform(0.0, 0.0, -0.3))
    for k in range(5):
        record.take(k + 1, STILL, expected, GUESS, Check(True, SHARP))
        record.settle(turned)
    erring = record.take(6, STILL, expected, GUESS, Check(False))
    assert erring.covariance[2, 2] == pytest.approx(0.01, rel=1e-3)
    np.testing.assert_allclose(erring.covariance[:2, :2], STILL.covariance[:2, :2], atol=1e-12)


def test_wheels_that_slip_go_on_slipping_until_something_tells_otherwise() -> None:
    """Half of the steps after one slip as well, by Bayes with what each scan says; 44 fine ones say so of no other."""
    record, expected = record_of(0, 44), replace(GUESS, a_T_b=planar_transform(-0.25, 0.0, 0.0))
    record.take(45, STILL, expected, GUESS, Check(True, SHARP))
    record.settle(AHEAD)

    def shares(*checks: Check) -> list[float]:
        steps = [record.take(46 + k, STILL, expected, GUESS, check) for k, check in enumerate(checks)]
        return [float(step.covariance[0, 0]) / 0.25**2 for step in steps]

    def either(goes_on: float) -> float:
        return 1.0 - (1.0 - goes_on) * 44 / 45  # or begins anew, as one in 45 did

    likelier = Check(False, NOWHERE, odds=float(np.log(3.0)))  # 1/8 before it was seen
    found = shares(Check(False, NOWHERE), Check(False, NOWHERE), likelier, Check(False, SHARP), Check(False, NOWHERE))
    known = [either(0.5), either(0.25), either(3.0 / 10.0), 0.0, either(0.0)]
    np.testing.assert_allclose(found, known, atol=1e-6)
