import numpy as np
import pytest

from spplanes.outlines import _raster, outline


def cells(mask):
    return np.argwhere(mask).astype(np.int64)


def outlined(mask):
    """The outline of the cells of a mask, 0.1 m wide, in the plane z = 0."""
    return outline.outline_from_cells(cells(mask), 0.1, 2, np.eye(4))


def plane_at(normal, point):
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    x = np.cross(n, [0.3, 0.5, -0.8])
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.column_stack((x, np.cross(n, x), n)), point
    return frame


def test_rectangle_l_shape_and_hole_have_their_areas():
    full = np.ones((20, 30), bool)
    assert outlined(full).area == pytest.approx(6.0)
    assert outlined(full).bounds == pytest.approx((0.0, 0.0, 2.0, 3.0))
    corner, hole = full.copy(), full.copy()
    corner[10:, 15:] = hole[5:10, 5:10] = False
    assert outlined(corner).area == pytest.approx(4.5)
    assert outlined(hole).area == pytest.approx(5.75)
    assert len(outlined(hole).interiors) == 1


def test_parts_apart_are_bridged_and_those_too_far_apart_leave_the_largest():
    near, far = np.ones((20, 31), bool), np.zeros((60, 80), bool)
    near[:, 14:16] = False
    assert outlined(near).geom_type == "Polygon"
    assert outlined(near).area == pytest.approx(20 * 31 * 0.01, rel=0.03)
    far[2:12, 2:12], far[40:52, 50:70] = True, True
    assert outlined(far).area == pytest.approx(2.4, rel=0.01)


def test_cells_that_touch_at_a_corner_are_valid_and_an_outline_that_folds_back_is_mended():
    assert outline.outline_from_cells(np.array([[0, 0], [1, 1], [0, 1]]), 1.0, 2, np.eye(4)).is_valid
    assert outlined(np.zeros((0, 2), bool)) is None
    shape = outlined(np.random.default_rng(0).random((40, 60)) < 0.55)
    assert shape.is_valid
    assert shape.geom_type == "Polygon"


@pytest.mark.parametrize("normal", [(1, 0.2, 0.1), (0.3, -1, 0.2), (0.1, 0.2, 1), (-1, 0.9, 0.8)])
def test_drawn_quads_cover_the_plane_with_its_area(normal):
    frame = plane_at(normal, (3.0, -2.0, 1.0))
    u, v = np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 1, 21), indexing="ij")
    points = frame[:3, 3] + u[..., None] * frame[:3, 0] + v[..., None] * frame[:3, 1]
    labels, axis = np.zeros(u.shape, dtype=np.int64), int(_raster.projection_axis(*frame[:3, 2]))
    keys = _raster.keys_of(*_raster.draw(points, labels, _raster.along_axes(np.array([axis]), 0.02)))
    assert (np.diff(keys) > 0).all()
    region, drawn = _raster.cells_of(keys)
    assert (region == 0).all()
    in_plane = outline.outlines_of_grid(points, labels, frame[None], np.array([0.02]))[0]
    for shape in (outline.outline_from_cells(drawn, 0.02, axis, frame), in_plane):
        assert shape.area == pytest.approx(2.0, rel=0.02)
        assert shape.centroid.x == pytest.approx(1.0, abs=0.02)
        assert shape.centroid.y == pytest.approx(0.5, abs=0.02)


def test_a_quad_with_one_foreign_corner_is_half_drawn():
    points = np.array([[[0.0, 0, 0], [0.0, 1, 0]], [[1.0, 0, 0], [1.0, 1, 0]]])
    for corner in range(4):
        labels = np.zeros((2, 2), dtype=np.int64)
        labels.flat[corner] = -1
        filled = _raster.draw(points, labels, _raster.along_axes(np.array([2]), 0.01))[0]
        assert filled.sum() == pytest.approx(5000, rel=0.03)


def test_regions_are_drawn_side_by_side_and_what_is_too_large_coarser():
    u, v = np.meshgrid(np.arange(5.0), np.arange(9.0), indexing="ij")
    points = np.stack((u, v, np.zeros_like(u)), axis=-1)
    labels = np.where(v < 4, 0, np.where(v < 5, -1, 2)).astype(np.int64)
    frames = np.tile(np.eye(4), (3, 1, 1))
    frames[2, :3, 3] = 2.0, 6.5, 0.0
    near, none, far = outline.outlines_of_grid(points, labels, frames, np.array([0.1, 0.1, 1e-4]))
    assert none is None
    assert near.bounds == pytest.approx((0.0, 0.0, 4.0, 3.0))
    np.testing.assert_allclose(far.bounds, (-2.0, -1.5, 2.0, 1.5), atol=0.01)
    assert far.area == pytest.approx(12.0, rel=0.01)


def test_cells_change_projection_with_the_plane():
    frame = plane_at((1, 1, 0.1), (0.5, 0.5, 0.0))
    drawn = cells(np.ones((20, 20), bool)) - 10
    moved = outline.in_projection(drawn, np.full(400, 0), 1, 0.1, frame)
    area = [outline.outline_from_cells(c, 0.1, axis, frame).area for c, axis in ((drawn, 0), (moved, 1))]
    assert area[1] == pytest.approx(area[0], rel=0.1)
    assert len(outline.in_projection(drawn, np.full(400, 2), 1, 0.1, frame)) == 0
    np.testing.assert_array_equal(outline.in_projection(drawn, np.full(400, 1), 1, 0.1, frame), drawn)


def test_a_sliver_of_any_length_fits_into_the_largest_raster():
    """Found by fuzzing: the frame of empty cells around a long thin raster took 150 GiB."""
    points = np.zeros((2, 3, 3))
    points[:, :, 0] = np.linspace(0.0, 1e9, 3)
    points[1, :, 1] = 1e-3
    projections = np.array([[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]])
    filled, _, _, _ = _raster.draw(points, np.zeros((2, 3), dtype=np.int64), projections)
    assert len(filled) <= 1.01 * _raster.LARGEST_RASTER
