"""Logs of real robots with one laser and raw wheel odometry: the loop closes, walls are single, relations hold."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
import shapely

from slam import PlaneSlam, SlamConfig
from slam.evaluation.relations import relation_errors
from slam.io.load import load
from slam.io.relations import read_relations
from slam.keyframes import keyframes_of
from tests.slam.real_data import needs


def run(name: str, count: int | None = None) -> PlaneSlam:
    log, rig = load(needs(name))
    slam = PlaneSlam(SlamConfig())
    for keyframe in islice(keyframes_of(log, rig, SlamConfig()), count):
        slam.add_keyframe(keyframe)
    return slam


@pytest.fixture(scope="module")
def corridors() -> PlaneSlam:
    """The office corridor loop."""
    return run("loop5/loop5.clf.gz")


def ends_of(slam: PlaneSlam, landmark_id: int) -> np.ndarray:
    """Ends of what was seen of a wall, in the world, shape (2, 2)."""
    frame = slam.landmarks.placed(landmark_id).world_T_plane
    corners = shapely.get_coordinates(slam.landmarks[landmark_id].outline) @ frame[:2, :2].T + frame[:2, 3]
    along = corners @ frame[:2, 0]
    return corners[[np.argmin(along), np.argmax(along)]]


@pytest.mark.xfail(
    strict=False, reason="the last corridor stays 0.3 m beside the first: its walls are taken for new ones"
)
def test_the_corridor_loop_closes(corridors):
    """The walls of the first corridor are matched again at the end, and no wall of the end stands a corridor beside."""
    again = [
        landmark
        for landmark in corridors.landmarks
        if landmark.sightings[0].keyframe < 15 and landmark.sightings[-1].keyframe > 110
    ]
    assert len(again) >= 2
    normals = [corridors.landmarks.placed(landmark.id).normal[1] for landmark in again]
    assert min(normals) < -0.9 and max(normals) > 0.9  # both sides of it


def test_the_corridors_are_square_and_few_walls_are_double(corridors):
    """Long walls of a rectangular building differ by multiples of 90 deg."""
    walls = [one for one in corridors.landmarks if one.n_keyframes >= 5]
    long = [one for one in walls if np.linalg.norm(np.subtract(*ends_of(corridors, one.id))) > 6.0]
    normals = np.array([corridors.landmarks.placed(one.id).normal for one in long])
    angles = np.rad2deg(np.arctan2(normals[:, 1], normals[:, 0])) * 4.0
    mean = np.rad2deg(np.angle(np.exp(1j * np.deg2rad(angles)).mean()))
    spread = np.abs((angles - mean + 180.0) % 360.0 - 180.0) / 4.0
    assert len(long) >= 5
    assert spread.max() < 5.0
    assert len(corridors.landmarks) <= 50


def test_the_audit_does_not_call_the_corridor_over_confident(corridors):
    (row,) = corridors.audit.summary()
    assert row.kind == "line" and row.count > 250
    assert row.verdict != "over-confident"


def test_the_start_of_the_intel_log_keeps_its_relations():
    """Every relation among the first 210 scans, about 100 m of rooms and corridors."""
    slam = run("intel/intel.clf.gz", 210)
    errors = relation_errors(slam.trajectory, read_relations(needs("intel/intel.relations.gz")))
    assert errors.translation_m.size >= 10
    assert errors.translation_m.mean() < 0.1
    assert np.rad2deg(errors.rotation_rad).mean() < 1.2
    curvature = slam.calibration.mean[1]
    assert curvature > 0.03  # the wheels turn it to one side, 4 deg per metre
