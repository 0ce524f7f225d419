import numpy as np
import pytest

from spplanes import outline


def cells(mask):
    return np.argwhere(mask).astype(np.int64)


def plane_at(normal, point):
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    x = np.cross(n, [0.3, 0.5, -0.8])
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.column_stack((x, np.cross(n, x), n)), point
    return frame


def test_rectangle_l_shape_and_hole_have_their_areas():
    full = np.ones((20, 30), bool)
    shape = outline.outline_from_cells(cells(full), 0.1, 2, np.eye(4))
    assert shape.area == pytest.approx(6.0)
    assert shape.bounds == pytest.approx((0.0, 0.0, 2.0, 3.0))
    corner = full.copy()
    corner[10:, 15:] = False
    assert outline.outline_from_cells(cells(corner), 0.1, 2, np.eye(4)).area == pytest.approx(4.5)
    hole = full.copy()
    hole[5:10, 5:10] = False
    shape = outline.outline_from_cells(cells(hole), 0.1, 2, np.eye(4))
    assert shape.area == pytest.approx(5.75)
    assert len(shape.interiors) == 1


def test_parts_apart_are_bridged():
    mask = np.ones((20, 31), bool)
    mask[:, 14:16] = False
    shape = outline.outline_from_cells(cells(mask), 0.1, 2, np.eye(4))
    assert shape.geom_type == "Polygon"
    assert shape.area == pytest.approx(20 * 31 * 0.01, rel=0.03)


def test_cells_that_touch_at_a_corner_are_valid():
    shape = outline.outline_from_cells(np.array([[0, 0], [1, 1], [0, 1]]), 1.0, 2, np.eye(4))
    assert shape.is_valid
    assert outline.outline_from_cells(np.empty((0, 2), dtype=np.int64), 1.0, 2, np.eye(4)) is None


@pytest.mark.parametrize("normal", [(1, 0.2, 0.1), (0.3, -1, 0.2), (0.1, 0.2, 1), (-1, 0.9, 0.8)])
def test_drawn_quads_cover_the_plane_with_its_area(normal):
    frame = plane_at(normal, (3.0, -2.0, 1.0))
    u, v = np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 1, 21), indexing="ij")
    points = frame[:3, 3] + u[..., None] * frame[:3, 0] + v[..., None] * frame[:3, 1]
    labels, axis = np.zeros(u.shape, dtype=np.int64), outline.projection_axis(*frame[:3, 2])
    keys, count = np.empty(4, dtype=np.int64), 0
    for i in range(40):
        keys, count = outline.draw_quads(
            points[i], points[i + 1], labels[i], labels[i + 1], np.array([axis]), np.array([0.02]), keys, count
        )
    region, drawn = outline.cells_of(np.unique(keys[:count]))
    assert (region == 0).all()
    shape = outline.outline_from_cells(drawn, 0.02, int(axis), frame)
    assert shape.area == pytest.approx(2.0, rel=0.02)
    assert shape.centroid.x == pytest.approx(1.0, abs=0.02)
    assert shape.centroid.y == pytest.approx(0.5, abs=0.02)


def test_a_quad_with_one_foreign_corner_is_half_drawn():
    above = np.array([[0.0, 0, 0], [0.0, 1, 0]])
    below = above + np.array([1.0, 0, 0])
    for corner in range(4):
        labels = np.zeros(4, dtype=np.int64)
        labels[corner] = -1
        keys, count = outline.draw_quads(
            above, below, labels[:2], labels[2:], np.array([2]), np.array([0.01]), np.empty(8, dtype=np.int64), 0
        )
        assert len(np.unique(keys[:count])) == pytest.approx(5000, rel=0.03)


def test_cells_change_projection_with_the_plane():
    frame = plane_at((1, 1, 0.1), (0.5, 0.5, 0.0))
    drawn = cells(np.ones((20, 20), bool)) - 10
    moved = outline.in_projection(drawn, np.full(400, 0), 1, 0.1, frame)
    area = [outline.outline_from_cells(c, 0.1, axis, frame).area for c, axis in ((drawn, 0), (moved, 1))]
    assert area[1] == pytest.approx(area[0], rel=0.1)
    assert len(outline.in_projection(drawn, np.full(400, 2), 1, 0.1, frame)) == 0
    np.testing.assert_array_equal(outline.in_projection(drawn, np.full(400, 1), 1, 0.1, frame), drawn)
