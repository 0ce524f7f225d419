"""Corners, lengths, distances and areas: their derivatives, what they do not depend on, and how they are written."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from slam.floorplan.quantities import Corner, Quantity, Section, area, corner, distance, length
from tests.statistics import assert_jacobian

#: Floor, then five walls of a room that is no rectangle, none of them exactly upright.
HESSE = np.array(
    [
        [0.01, -0.02, 1.0, 0.1],
        [0.0, 1.0, 0.01, -2.0],
        [-1.0, 0.1, 0.0, -3.0],
        [-0.1, -1.0, 0.02, -2.5],
        [0.6, -0.8, 0.0, -2.6],
        [1.0, 0.05, -0.01, -3.5],
    ]
)
HESSE /= np.linalg.norm(HESSE[:, :3], axis=1, keepdims=True)


def corners(hesse: np.ndarray) -> tuple[list[Corner], Section]:
    cut = Section(hesse[0, :3], float(hesse[0, 3]) + 1.2, 0)
    return [corner(hesse, a, b, cut) for a, b in ((5, 1), (1, 2), (2, 3), (3, 4), (4, 5))], cut


def room(hesse: np.ndarray) -> tuple[float, np.ndarray]:
    ends, cut = corners(hesse)
    return area([ends], cut)


def side(hesse: np.ndarray) -> tuple[float, np.ndarray]:
    return length(*corners(hesse)[0][1:3])


def width(hesse: np.ndarray) -> tuple[float, np.ndarray]:
    return distance(hesse, 1, 3, np.array([0.3, 0.1, 1.0]), np.array([0.0, 0.995, 0.0]) / 0.995)


@pytest.mark.parametrize("measure", [room, side, width])
def test_derivatives_by_central_differences(measure):
    """Along everything that keeps normals unit: a normal turned, a distance changed."""
    tangents = block_diag(*(np.linalg.svd([[*normal, 0.0]])[2][1:] for normal in HESSE[:, :3]))

    def moved(steps: np.ndarray) -> np.ndarray:
        hesse = HESSE + (tangents.T @ steps).reshape(-1, 4)
        hesse[:, :3] /= np.linalg.norm(hesse[:, :3], axis=1, keepdims=True)
        return np.array([measure(hesse)[0]])

    jacobian = (measure(HESSE)[1].ravel() @ tangents.T)[None]
    assert_jacobian(moved, np.zeros(len(tangents)), jacobian, atol=1e-8, rtol=1e-6)
    assert np.abs(jacobian).max() > 0.1


@pytest.mark.parametrize("measure", [room, side])
def test_where_the_world_begins_changes_nothing(measure):
    """All planes turned and shifted together: the same number; and to first order no error comes of it."""
    rotation, shift = Rotation.from_rotvec([0.2, -0.3, 1.0]).as_matrix(), np.array([3.0, -1.0, 2.0])
    normals = HESSE[:, :3] @ rotation.T
    there = np.column_stack((normals, HESSE[:, 3] + normals @ shift))
    assert measure(there)[0] == pytest.approx(measure(HESSE)[0], abs=1e-12)
    for turn, step in zip(np.eye(6)[:, :3], np.eye(6)[:, 3:], strict=True):
        change = np.column_stack((np.cross(turn, HESSE[:, :3]), HESSE[:, :3] @ step))
        assert measure(HESSE)[1].ravel() @ change.ravel() == pytest.approx(0.0, abs=1e-10)


def test_a_rectangle():
    walls = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, -4], [0, -1, 0, -3], [1, 0, 0, 0]], dtype=float)
    cut = Section(walls[0, :3], 1.0, 0)
    ends = [corner(walls, a, b, cut) for a, b in ((4, 1), (1, 2), (2, 3), (3, 4))]
    np.testing.assert_allclose([one.point for one in ends], [[0, 0, 1], [4, 0, 1], [4, 3, 1], [0, 3, 1]], atol=1e-15)
    value, gradient = area([ends], cut)
    assert value == pytest.approx(12.0)
    assert gradient[2, 3] == pytest.approx(-3.0)  # d of the wall at x = 4 is -4: one closer takes its length away
    hole = [corner(walls, a, b, cut) for a, b in ((4, 1), (3, 4), (2, 3), (1, 2))]
    assert area([ends, hole], cut)[0] == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (2.38812, 0.00412, "2.388 +- 0.004"),
        (2.38812, 0.00152, "2.3881 +- 0.0015"),
        (12.3456, 0.3, "12.3 +- 0.3"),
        (2.5, 0.00003, "2.50000 +- 0.00003"),
        (2.5, 0.0, "2.500000 +- 0.000000"),
        (25.0, 13.0, "25 +- 13"),
    ],
)
def test_texts(value: float, sigma: float, text: str):
    assert str(Quantity(value, sigma, np.zeros((0, 4)))) == text
