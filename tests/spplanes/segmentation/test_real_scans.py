"""Other people's data: labelled frames, and a corridor, a room and a hall that must look right."""

import numpy as np
import pytest

from benchmarks import scenes
from slam.io.clouds import read_cloud
from spplanes import MapperConfig, segment_scans
from spplanes.clouds.arrange import arrange
from spplanes.noise import SensorModel
from tests.slam.real_data import DATA, needs

#: The upright laser of pcl_room: 1 cm of range noise; slices tilt by millimetres each; its ranges are off by up to 4 cm
#: depending on the distance, so that a flat ceiling comes out as a bowl.
ROOM_SENSOR = SensorModel(
    range_sigma_m=0.01,
    bearing_sigma_rad=0.003,
    scan_shift_sigma_m=0.003,
    scan_tilt_sigma_rad=0.003,
    surface_sigma_m=0.02,
)
#: Nearer than this that laser sees the robot, m.
ROOM_RANGE_M = 0.8


def segmented(points, model):
    """Labels and planes with the noise of a sensor, what its scans share included."""
    return segment_scans(
        points,
        model.covariances(points),
        viewpoints=(0.0, 0.0, 0.0),
        pose_covariances=np.tile(model.scan_covariance(), (len(points), 1, 1)),
        config=MapperConfig(flatness_m=0.5 * model.surface_sigma_m),
    )


@pytest.mark.parametrize(("noise_seed", "at_least"), [(None, 14), (0, 9), (1, 9), (2, 9)])
def test_labelled_depth_image(noise_seed, at_least):
    needs("icl_labelled")
    points, sigma, truth = scenes.icl_frame(DATA, noise_seed)
    labels, planes = segment_scans(points, sigma=sigma)
    assert scenes.correct_detections(labels, truth) >= at_least
    assert all(plane.outline.is_valid for plane in planes)


def test_organised_terrestrial_scan():
    needs("synpeb")
    points, sigma, truth = scenes.synpeb_scan(DATA)
    labels, _ = segment_scans(points, sigma=sigma)
    assert scenes.correct_detections(labels, truth) >= 10


@pytest.mark.parametrize("index", [0, 1, 2])
def test_corridor_has_whole_floor_ceiling_and_left_wall(index):
    needs("3dtk_corridor")
    points = scenes.corridor_scan(DATA, index)
    model = scenes.CORRIDOR_SENSOR
    labels, planes = segmented(points, model)
    returns = np.isfinite(points).all(axis=-1)
    assert (labels >= 0).sum() > 0.85 * returns.sum()
    floor, ceiling, wall = (
        max((p for p in planes if p.normal @ normal > 0.98), key=lambda p: p.n_points)
        for normal in ((0, 0, 1), (0, 0, -1), (0, 1, 0))
    )
    assert min(floor.n_points, wall.n_points) > 14000
    assert ceiling.n_points > 5000
    for plane in (floor, ceiling, wall):
        others = [q for q in planes if q is not plane and q.normal @ plane.normal > 0.99]
        same = [q for q in others if abs(plane.distance(q.centre)) < 0.05]
        assert sum(q.n_points for q in same) < 0.15 * plane.n_points
    assert -ceiling.d - floor.d == pytest.approx(2.42, abs=0.06)
    assert 2e-4 < np.sqrt(floor.covariance[0, 0]) < 0.015
    off = [p.n_points for k, p in enumerate(planes) if np.std(p.distance(points[labels == k])) > 0.04]
    assert sum(off) < 0.06 * returns.sum()
    if index == 0:  # door frames at other depths are planes of their own
        across = np.sort([p.d for p in planes if p.normal[1] < -0.99 and p.n_points > 500 and p.d < -3.0])
        assert len(across) >= 3 and (np.diff(across) > 0.05).all()


def pieces(planes, normal_z):
    """Planes that face up or down, largest first, and how many points others at the height of the largest have."""
    level = sorted((p for p in planes if p.normal[2] * normal_z > 0.98), key=lambda p: -p.n_points)
    return level[0], sum(p.n_points for p in level[1:] if abs(level[0].distance(p.centre)) < 0.1)


@pytest.mark.parametrize("index", [1, 2])
def test_room_from_vertical_slices(index):
    needs("pcl_room")
    points = arrange(read_cloud(DATA / "pcl_room" / f"room_scan{index}.pcd").points)  # vertical slices, (lines, 181, 3)
    points[np.linalg.norm(points, axis=-1) < ROOM_RANGE_M] = np.nan
    labels, planes = segmented(points, ROOM_SENSOR)
    floor, others = pieces(planes, 1.0)
    assert floor.d == pytest.approx(-1.26, abs=0.03)
    assert floor.n_points > 5000
    assert others < 0.1 * floor.n_points
    ceiling, _ = pieces(planes, -1.0)
    assert ceiling.d == pytest.approx(-1.67, abs=0.03)
    assert ceiling.n_points > 13000
    for k, plane in enumerate(planes):
        if plane.n_points > 1000:
            assert np.std(plane.distance(points[labels == k])) < 0.03
