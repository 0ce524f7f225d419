import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spplanes import Location, spmodel
from spplanes.spmodel import adjoint, inverse_transform, joint_covariance, rpy_from_transform, transform_from_rpy
from tests.statistics import assert_jacobian, central_differences

BINDINGS = [(0, 1, 2), (2, 4, 5), (1, 3), (0, 1, 3), (0, 1, 2, 3, 4, 5), (4,)]
ANGLES = st.sampled_from([0.0, 1e-9, 0.3, -1.2, np.pi / 2, -np.pi / 2, np.pi - 1e-7, np.pi, -np.pi])
POSES = st.tuples(*[st.floats(-50.0, 50.0)] * 3, ANGLES, ANGLES, ANGLES).map(transform_from_rpy)


def random_location(rng, rows=(0, 1, 2, 3, 4, 5), scale=1e-2):
    root = scale * rng.normal(size=(len(rows), len(rows)))
    d = rng.uniform(-1, 1, 6) * [5, 5, 5, np.pi, 1.5, np.pi]
    return Location(transform_from_rpy(d), root @ root.T, rows)


def test_rpy_is_rz_ry_rx():
    quarter = np.pi / 2
    # Rx(90) takes z to -y, Ry(90) leaves -y, Rz(90) takes -y to x.
    t = transform_from_rpy((1.0, 2.0, 3.0, quarter, quarter, quarter))
    np.testing.assert_allclose(t[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(t[:3, 3], [1, 2, 3])


@given(POSES)
def test_rpy_round_trip_at_every_angle(transform):
    np.testing.assert_allclose(transform_from_rpy(rpy_from_transform(transform)), transform, atol=1e-7)


def test_adjoint_against_central_differences():
    rng = np.random.default_rng(1)
    for _ in range(20):
        t = random_location(rng).transform

        def carried(d, t=t):
            return rpy_from_transform(t @ transform_from_rpy(d) @ inverse_transform(t))

        assert_jacobian(carried, np.zeros(6), adjoint(t), atol=1e-7)


@pytest.mark.parametrize("rows_a", BINDINGS)
@pytest.mark.parametrize("rows_b", BINDINGS)
def test_compose_and_relative_propagate_as_central_differences_do(rows_a, rows_b):
    rng = np.random.default_rng(2)
    a, b = random_location(rng, rows_a), random_location(rng, rows_b)
    cross = 0.3 * np.linalg.cholesky(a.covariance)[:, :1] @ np.linalg.cholesky(b.covariance)[:, :1].T
    joint, k = joint_covariance(a, b, cross), len(rows_a)

    def composed(p):
        there = a.perturbed(p[:k]).transform @ b.perturbed(p[k:]).transform
        return a.compose(b).perturbation_to(there)

    def related(p):
        there = inverse_transform(a.perturbed(p[:k]).transform) @ b.perturbed(p[k:]).transform
        return a.relative(b).perturbation_to(there)

    for function, result in ((composed, a.compose(b, cross)), (related, a.relative(b, cross))):
        jacobian = central_differences(function, np.zeros(len(joint)))
        np.testing.assert_allclose(result.covariance, jacobian @ joint @ jacobian.T, rtol=1e-6, atol=1e-12)
        assert result.rows == rows_b


@pytest.mark.parametrize("rows", BINDINGS)
def test_inverse_propagates_as_central_differences_do(rows):
    a = random_location(np.random.default_rng(3), rows)

    def inverted(p):
        return a.inverse().perturbation_to(inverse_transform(a.perturbed(p).transform))

    jacobian = central_differences(inverted, np.zeros(len(rows)))
    np.testing.assert_allclose(a.inverse().covariance, jacobian @ a.covariance @ jacobian.T, rtol=1e-6, atol=1e-12)


def test_relative_to_itself_is_certain_when_fully_correlated():
    a = random_location(np.random.default_rng(6))
    same = a.relative(a, cross=a.covariance)
    np.testing.assert_allclose(same.transform, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(same.covariance, 0.0, atol=1e-17)


def test_line_seen_from_a_robot():
    """A wall along x, 3 m to the left of a robot at (10, 0).

    When the robot turns by dphi, the wall's origin, at (-10, 3), moves by +10 dphi along y, and the wall by -dphi.
    """
    line = Location.line_2d(0.0, 3.0, 0.0, np.diag([0.02**2, 0.001**2]))
    robot = Location.robot_2d(10.0, 0.0, 0.0, np.diag([0.1**2, 0.03**2, 0.01**2]))
    seen = robot.relative(line)
    np.testing.assert_allclose(seen.rpy[:2], [-10.0, 3.0])
    expected = [[0.02**2 + 0.03**2 + (10 * 0.01) ** 2, -10 * 0.01**2], [-10 * 0.01**2, 0.001**2 + 0.01**2]]
    np.testing.assert_allclose(seen.covariance, expected, rtol=1e-12)


def test_binding_selects_rows():
    plane = Location.plane(np.eye(4), np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(plane.binding, np.eye(6)[[2, 4, 5]])
    np.testing.assert_array_equal(plane.differential_covariance, np.diag([0, 0, 1.0, 0, 2.0, 3.0]))
    assert spmodel.rows_of(("z", "theta", "psi")) == (2, 4, 5)
