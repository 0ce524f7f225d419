"""The Symmetries and Perturbation model: uncertain locations of geometric objects, composed, inverted and related.

References:
    Castellanos, Tardos, "Mobile Robot Localization and Map Building", 1999, chapter 2 (the SPmodel).
    Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section II.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import (
    TOO_LARGE,
    FloatArray,
    as_covariance,
    as_float_array,
    as_number,
    as_rows,
    as_shape,
    as_transform,
    check_instance,
)

#: The differential, in order; a binding is a selection of these.
DIFFERENTIAL = ("x", "y", "z", "phi", "theta", "psi")
PLANE = (2, 4, 5)
POSE = (0, 1, 2, 3, 4, 5)


def transform_from_rpy(d: ArrayLike) -> FloatArray:
    """(4, 4) transform of (x, y, z, phi, theta, psi), m and rad: R = Rz(phi) Ry(theta) Rx(psi)."""
    x, y, z, phi, theta, psi = as_shape("d", d, (6,))
    ca, cb, cc = np.cos((phi, theta, psi))
    sa, sb, sc = np.sin((phi, theta, psi))
    return np.array(
        [
            [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc, x],
            [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc, y],
            [-sb, cb * sc, cb * cc, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def rpy_from_transform(transform: ArrayLike) -> FloatArray:
    """(x, y, z, phi, theta, psi) of a (4, 4) transform, theta in [-pi/2, pi/2]; where theta = +-pi/2, psi = 0."""
    t = as_transform("transform", transform)
    cos_theta = np.hypot(t[0, 0], t[1, 0])
    theta = np.arctan2(-t[2, 0], cos_theta)
    if cos_theta > 1e-12:
        phi, psi = np.arctan2(t[1, 0], t[0, 0]), np.arctan2(t[2, 1], t[2, 2])
    else:
        phi, psi = np.arctan2(-t[0, 1], t[1, 1]), 0.0
    return np.array([*t[:3, 3], phi, theta, psi])


def inverse_transform(transform: FloatArray) -> FloatArray:
    """Inverse of a rigid (4, 4) transform."""
    inverse, turn = np.zeros((4, 4)), transform[:3, :3].T
    inverse[:3, :3], inverse[:3, 3], inverse[3, 3] = turn, -(turn @ transform[:3, 3]), 1.0
    return inverse


def skew(v: FloatArray) -> FloatArray:
    """(3, 3) matrix of the cross product v x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(transform: FloatArray) -> FloatArray:
    """(6, 6) Jacobian J of a differential moved through a transform: T o d = (J d) o T to first order.

    Both differentials are (x, y, z, phi, theta, psi). To first order the angles are the rotation vector backwards.
    """
    rotation = transform[:3, :3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = rotation
    jacobian[:3, 3:] = (skew(transform[:3, 3]) @ rotation)[:, ::-1]
    jacobian[3:, 3:] = rotation[::-1, ::-1]
    return jacobian


@dataclass(frozen=True, eq=False)
class Location:
    """An uncertain location of a geometric object: transform, binding, covariance of the perturbation.

    True location = `transform` o d, with d = B^T p = (x, y, z, phi, theta, psi), R = Rz(phi) Ry(theta) Rx(psi): the
    perturbation is composed on the right, i.e. expressed in the object's own frame. The binding matrix B selects the
    rows of d that matter; the others are symmetries of the object. p has zero mean. Rotations are matrices inside:
    no angle is singular.
    """

    transform: FloatArray
    """world_T_object, shape (4, 4)."""
    covariance: FloatArray
    """Covariance of p, shape (k, k), in the order of `rows`; m, rad."""
    rows: tuple[int, ...] = POSE
    """Rows of d kept by the binding matrix, ascending, indices into (x, y, z, phi, theta, psi)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", as_rows("rows", self.rows))
        transform = as_transform("transform", self.transform)
        object.__setattr__(self, "transform", transform.copy() if transform is self.transform else transform)
        object.__setattr__(self, "covariance", as_covariance("covariance", self.covariance, len(self.rows)))

    @classmethod
    def _trusted(cls, transform: FloatArray, covariance: FloatArray, rows: tuple[int, ...]) -> Location:
        """A location from values that follow from good ones: rounding must not make them bad."""
        location = object.__new__(cls)
        location.__dict__.update(transform=transform, covariance=covariance, rows=rows)
        return location

    @classmethod
    def point(cls, position: ArrayLike, covariance: ArrayLike) -> Location:
        """A 3D point: p = (x, y, z)."""
        transform = np.eye(4)
        transform[:3, 3] = as_shape("position", position, (3,))
        return cls(transform, as_float_array("covariance", covariance), (0, 1, 2))

    @classmethod
    def plane(cls, frame: ArrayLike, covariance: ArrayLike) -> Location:
        """An infinite plane, z = 0 of `frame`: p = (z, theta, psi)."""
        return cls(as_float_array("frame", frame), as_float_array("covariance", covariance), PLANE)

    @classmethod
    def line_2d(cls, x: float, y: float, phi: float, covariance: ArrayLike) -> Location:
        """An infinite line on the floor through (x, y) in direction phi, its own x axis: p = (y, phi)."""
        return cls(_on_floor(x, y, phi), as_float_array("covariance", covariance), (1, 3))

    @classmethod
    def robot_2d(cls, x: float, y: float, phi: float, covariance: ArrayLike) -> Location:
        """A robot on the floor: p = (x, y, phi)."""
        return cls(_on_floor(x, y, phi), as_float_array("covariance", covariance), (0, 1, 3))

    @classmethod
    def pose(cls, transform: ArrayLike, covariance: ArrayLike) -> Location:
        """A full pose: p = d."""
        return cls(as_float_array("transform", transform), as_float_array("covariance", covariance), POSE)

    @property
    def binding(self) -> FloatArray:
        """The binding matrix B, shape (k, 6): p = B d."""
        return np.eye(6)[list(self.rows)]

    @property
    def differential_covariance(self) -> FloatArray:
        """Covariance of d = B^T p, shape (6, 6), zero along the symmetries."""
        return self.binding.T @ self.covariance @ self.binding

    @property
    def rpy(self) -> FloatArray:
        """The transform as (x, y, z, phi, theta, psi), shape (6,), m and rad."""
        return rpy_from_transform(self.transform)

    def perturbed(self, p: ArrayLike) -> Location:
        """The location moved by the perturbation ``p``, shape (k,); the covariance stays."""
        d = self.binding.T @ as_shape("p", p, (len(self.rows),))
        return Location._trusted(self.transform @ transform_from_rpy(d), self.covariance, self.rows)

    def perturbation_to(self, transform: ArrayLike) -> FloatArray:
        """The p, shape (k,), that leads from here to ``transform`` (4, 4); what the binding drops is ignored."""
        there = as_transform("transform", transform)
        return rpy_from_transform(inverse_transform(self.transform) @ there)[list(self.rows)]

    def compose(self, other: Location, cross: ArrayLike | None = None) -> Location:
        """``self`` o ``other``: the object ``other``, known in this frame, seen from where this frame is known.

        Keeps the binding of ``other``. To first order d = Ad(other^-1) d_self + d_other.

        Args:
            other: location in the frame of this one.
            cross: covariance of (p_self, p_other), shape (k_self, k_other); without it they are independent.

        Raises:
            ValueError: ``cross`` has another shape, or makes the joint covariance indefinite.
        """
        check_instance("other", other, Location)
        carry = other.binding @ adjoint(inverse_transform(other.transform)) @ self.binding.T
        return Location._trusted(self.transform @ other.transform, _propagate(carry, self, other, cross), other.rows)

    def inverse(self) -> Location:
        """The world seen from this frame: d = -Ad(self) B^T p, with all six rows bound."""
        carry = -adjoint(self.transform) @ self.binding.T
        covariance = _symmetric(carry @ self.covariance @ carry.T)
        return Location._trusted(inverse_transform(self.transform), covariance, POSE)

    def relative(self, other: Location, cross: ArrayLike | None = None) -> Location:
        """self^-1 o ``other``: ``other``, known in the world, seen from this frame; keeps the binding of ``other``.

        To first order d = -Ad(relative^-1) d_self + d_other. Arguments and errors are as of `compose`, but ``other`` is
        in the same frame as this one.
        """
        check_instance("other", other, Location)
        transform = inverse_transform(self.transform) @ other.transform
        carry = -other.binding @ adjoint(inverse_transform(transform)) @ self.binding.T
        return Location._trusted(transform, _propagate(carry, self, other, cross), other.rows)


def _propagate(carry: FloatArray, a: Location, b: Location, cross: ArrayLike | None) -> FloatArray:
    """Covariance of ``carry`` p_a + p_b from their joint covariance."""
    jacobian = np.hstack([carry, np.eye(len(b.rows))])
    return _symmetric(jacobian @ joint_covariance(a, b, cross) @ jacobian.T)


def joint_covariance(a: Location, b: Location, cross: ArrayLike | None = None) -> FloatArray:
    """Covariance of (p_a, p_b), shape (k_a + k_b, k_a + k_b), checked to be one."""
    k = len(a.rows)
    joint = np.zeros((k + len(b.rows),) * 2)
    joint[:k, :k], joint[k:, k:] = a.covariance, b.covariance
    if cross is None:
        return joint
    joint[:k, k:] = as_shape("cross", cross, (k, len(b.rows)))
    joint[k:, :k] = joint[:k, k:].T
    return as_covariance("cross", joint, len(joint))


def _on_floor(x: float, y: float, phi: float) -> FloatArray:
    return transform_from_rpy((as_number("x", x), as_number("y", y), 0.0, as_number("phi", phi), 0.0, 0.0))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def rows_of(names: Sequence[str]) -> tuple[int, ...]:
    """Binding rows by name, e.g. ``rows_of(("z", "theta", "psi"))``."""
    unknown = [name for name in names if name not in DIFFERENTIAL]
    if unknown:
        raise ValueError(f"names: expected some of {', '.join(DIFFERENTIAL)}, got {unknown[0]!r}")
    return as_rows("names", tuple(DIFFERENTIAL.index(name) for name in names))


def chi2_of(difference: FloatArray, covariance: FloatArray) -> float:
    """difference^T covariance^-1 difference, which may be singular; infinite where a certain direction differs."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale[scale <= 1.0 / TOO_LARGE] = 1.0  # certain
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    parts = vectors.T @ (difference / scale)
    certain = values <= 1e-14
    if (np.abs(parts[certain]) > 1e-12).any():
        return np.inf
    return float(np.sum(parts[~certain] ** 2 / values[~certain]))
