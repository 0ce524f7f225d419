"""Other people's data: labelled frames, and a corridor, a room and a hall that must look right."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import extraction
from spplanes import segment_scans
from spplanes.segmentation import organise

DATA = Path(__file__).parents[2].parent / "shared" / "data"


def needs(folder):
    return pytest.mark.skipif(not (DATA / folder).is_dir(), reason=f"real data not here: {folder}")


@needs("icl_labelled")
@pytest.mark.parametrize(("noise_seed", "at_least"), [(None, 14), (0, 7)])
def test_labelled_depth_image(noise_seed, at_least):
    points, sigma, truth = extraction.icl_frame(DATA, noise_seed)
    labels, planes = segment_scans(points, sigma=sigma)
    assert extraction.correct_detections(labels, truth) >= at_least
    assert all(plane.outline.is_valid for plane in planes)


@needs("synpeb")
def test_organised_terrestrial_scan():
    points, sigma, truth = extraction.synpeb_scan(DATA)
    labels, _ = segment_scans(points, sigma=sigma)
    assert extraction.correct_detections(labels, truth) >= 10


@needs("3dtk_corridor")
@pytest.mark.parametrize("index", [0, 1, 2])
def test_corridor_has_whole_floor_ceiling_and_left_wall(index):
    points = extraction.corridor_scan(DATA, index)
    model = extraction.CORRIDOR_SENSOR
    labels, planes = segment_scans(
        points,
        model.covariances(points),
        viewpoints=(0.0, 0.0, 0.0),
        pose_covariances=np.tile(model.scan_covariance(), (len(points), 1, 1)),
    )
    returns = np.isfinite(points).all(axis=-1)
    assert (labels >= 0).sum() > 0.85 * returns.sum()
    floor = max((p for p in planes if p.normal[2] > 0.98), key=lambda p: p.n_points)
    ceiling = max((p for p in planes if p.normal[2] < -0.98), key=lambda p: p.n_points)
    wall = max((p for p in planes if p.normal[1] > 0.98), key=lambda p: p.n_points)
    assert min(floor.n_points, wall.n_points) > 15000
    assert ceiling.n_points > 6000
    for plane in (floor, ceiling, wall):
        others = [q for q in planes if q is not plane and q.normal @ plane.normal > 0.99]
        same = [q for q in others if abs(plane.distance(q.centre)) < 0.05]
        assert sum(q.n_points for q in same) < 0.1 * plane.n_points
    assert -ceiling.d - floor.d == pytest.approx(2.42, abs=0.06)
    assert 5e-4 < np.sqrt(floor.covariance[0, 0]) < 0.015


@needs("pcl_room")
def test_room_from_vertical_slices():
    points = extraction.room_slices(DATA, 1)
    model = extraction.ROOM_SENSOR
    shared = np.tile(model.scan_covariance(), (len(points), 1, 1))
    _, planes = segment_scans(points, sigma=0.015, viewpoints=(0.0, 0.0, 0.0), pose_covariances=shared)
    floor = max((p for p in planes if p.normal[2] > 0.99), key=lambda p: p.n_points)
    ceiling = max((p for p in planes if p.normal[2] < -0.99), key=lambda p: p.n_points)
    assert floor.d == pytest.approx(-1.26, abs=0.03)
    assert ceiling.d == pytest.approx(-1.67, abs=0.03)


@needs("balm_hall")
def test_hall_from_an_unorganised_cloud():
    points = extraction.hall_cloud(DATA, 0)
    grid, index = organise(points, rows=64, cols=1024)
    labels, planes = segment_scans(grid, sigma=0.02, viewpoints=(0.0, 0.0, 0.0))
    assert (labels >= 0).sum() > 0.7 * (index >= 0).sum()
    floor = [p for p in planes if p.normal[2] > 0.99 and p.n_points > 5000]
    assert sum(p.n_points for p in floor) > 15000
    assert floor[0].d == pytest.approx(floor[1].d, abs=0.05)
    for k, plane in enumerate(planes):
        if plane.n_points > 500:
            assert np.std(plane.distance(points[index[labels == k]])) < 0.035
    assert any(abs(p.normal[0]) > 0.99 and p.n_points > 1000 for p in planes)
