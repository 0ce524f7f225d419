"""Depth cameras carried by hand: as fast as they say, bit for bit the same, their images those of the true planes."""

from __future__ import annotations

import itertools

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.handheld import make_handheld
from slam.geometry.frames import inverse, lift
from slam.io.clouds.depth import CAMERA_MOUNT


@pytest.fixture(scope="module", params=["handheld/far", "handheld/sparse_far"])
def drive(request):
    """One of each sort of room."""
    return make_handheld(request.param, 3)


def test_the_camera_moves_as_its_kind_says(drive) -> None:
    """Up to 0.5 m/s along x and y and 40 deg/s about z, at 3 images a second; it gets near both in 20 s."""
    poses = drive.truth.world_T_body
    steps = [gtsam.Pose3.Logmap(gtsam.Pose3(inverse(a) @ b)) for a, b in itertools.pairwise(poses)]
    turns, ways = (
        np.linalg.norm(np.array(steps)[:, :3], axis=1),
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1),
    )
    assert np.deg2rad(7.0) < turns.max() < np.deg2rad(18.0)
    assert 0.08 < ways.max() < 0.3


def test_points_lie_on_the_planes_they_are_labelled_with(drive) -> None:
    """Within what a Kinect's noise and, in sparse rooms, false depths make of them; half of all pixels see a plane."""
    sparse = drive.recipe.world == "hall"
    off, ranges = [], []
    truth = drive.truth
    images = list(zip(drive.log.scans(), truth.world_T_body, truth.labels["camera"], strict=True))
    for scan, pose, labels in images[::9]:
        on = labels >= 0
        points = lift(scan.points[on], pose @ CAMERA_MOUNT)
        planes = [truth.planes[label] for label in labels[on]]
        normals, d = np.array([plane.normal for plane in planes]), np.array([plane.d for plane in planes])
        off.append(np.abs(np.einsum("ki,ki->k", points, normals) - d))
        ranges.append(scan.points[on][:, 2])
        assert on.mean() > 0.3
    share = np.median(np.concatenate(off) / np.concatenate(ranges))
    assert share < (0.02 if sparse else 0.005)
