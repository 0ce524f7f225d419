"""Quaternions of files: one check for all readers."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.frames import norms_of, poses_of

QUARTER = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]


def test_a_quarter_turn_is_one():
    (pose,) = poses_of(np.array([[1.0, 2.0, 3.0, *QUARTER]]))
    np.testing.assert_allclose(pose[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(pose[:3, 3], [1.0, 2.0, 3.0])


def test_four_digits_are_enough_and_are_normalised():
    (pose,) = poses_of(np.array([[0.0, 0.0, 0.0, *np.round(QUARTER, 4)]]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("wrong", [[0.0] * 4, [0.0, 0.0, 1.0, 1.0], [np.nan, 0.0, 0.0, 1.0], [1e200, 0.0, 0.0, 1e200]])
def test_what_is_no_unit_is_told(wrong: list[float]):
    assert norms_of(np.array([wrong, QUARTER]))[1].tolist() == [True, False]
    with pytest.raises(ValueError, match="unit quaternion"):
        poses_of(np.array([[0.0, 0.0, 0.0, *QUARTER], [0.0, 0.0, 0.0, *wrong]]))


def test_a_position_that_is_nowhere_is_told():
    with pytest.raises(ValueError, match="finite positions"):
        poses_of(np.array([[np.inf, 0.0, 0.0, *QUARTER]]))
