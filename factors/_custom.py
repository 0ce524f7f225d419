"""Callbacks of ``gtsam.CustomFactor`` around the compiled kernels, and of a velocity that is kept.

GTSAM cannot say what is inside a custom factor. `describe` can: asked for an error without values, a callback hands
over its recipe with the refusal; `factors.archive` writes and reads recipes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import gtsam
import numpy as np

from factors._check import held
from factors.robust import Robust, gaussian
from spplanes._check import FloatArray

_Kernel = Callable[..., tuple[FloatArray, FloatArray]]

#: Of the frame of the world, as the kernels take it.
IDENTITY = np.asfortranarray(np.eye(4))
#: Where (x, y, yaw) of a Pose2 are in (rx, ry, rz, x, y, z) of a Pose3: the same right-hand tangent, to first order.
OF_POSE2 = np.array([3, 4, 2])


@dataclass(frozen=True, eq=False)
class Recipe:
    """All that makes a custom factor: its error is ``kernel(world_T_anchor, world_T_body, landmark, *data)``."""

    kernel: str
    """What it is an error of: plane, line, direction, parallel, perpendicular, distance, map."""
    data: tuple[FloatArray | float, ...]
    """The measurement, as the kernel takes it."""
    root_information: FloatArray
    """Upper triangular R of the noise, shape (m, m)."""
    dof: int
    """Degrees of freedom of the error; it may have more components."""
    plane_key: int
    """The landmark, an ``OrientedPlane3``."""
    pose_key: int | None = None
    """The pose it is seen from; None: the world."""
    anchor_key: int | None = None
    """The pose in whose frame it lives; None: the world. The same as `pose_key`: both drop out."""
    reference_key: int | None = None
    """A second landmark, living in the frame of `pose_key`, that the kernel takes before ``data``."""
    more_keys: tuple[int, ...] = ()
    """Landmarks of a map after these two."""
    planar: bool = False
    """The poses are known to be ``Pose2``; they may be anyway."""
    robust: Robust = None
    """Kernel of the noise model."""

    @property
    def landmark_keys(self) -> tuple[int, ...]:
        """All its landmarks, in the order in which the kernel takes them."""
        second = () if self.reference_key is None else (self.reference_key,)
        return (self.plane_key, *second, *self.more_keys)

    def factor(self) -> gtsam.CustomFactor:
        """Make the factor. Its keys are (pose, anchor, plane, reference, more), those that there are."""
        poses = () if self.pose_key == self.anchor_key else (self.pose_key, self.anchor_key)
        noise = gaussian(self.root_information, self.robust, self.dof)
        keys = [key for key in poses if key is not None]
        return gtsam.CustomFactor(noise, [*keys, *self.landmark_keys], _callback(self))

    def rekeyed(self, names: Mapping[int, int], homes: Mapping[int, tuple[int, int]]) -> Recipe:
        """The same over other variables; see `factors.archive.rekeyed`, which refuses new homes of several planes."""
        keys = {role: getattr(self, role) for role in ("plane_key", "pose_key", "anchor_key", "reference_key")}
        roles: dict[str, Any] = {role: names.get(key, key) for role, key in keys.items()}
        roles["more_keys"] = tuple(names.get(key, key) for key in self.more_keys)
        if self.plane_key in homes:
            roles["plane_key"], roles["anchor_key"] = homes[self.plane_key]
        return replace(self, **roles)

    @staticmethod
    def of(plain: dict[str, Any]) -> Recipe:
        """Of its fields as JSON has them."""
        fields = dict(plain)
        fields["data"] = tuple(np.array(array) if isinstance(array, list) else float(array) for array in plain["data"])
        fields["root_information"] = np.array(plain["root_information"])
        fields["more_keys"] = tuple(plain.get("more_keys", ()))
        fields["robust"] = plain["robust"] and tuple(plain["robust"])
        return Recipe(**fields)


@dataclass(frozen=True, eq=False)
class VelocityRecipe:
    """All that makes a factor of a velocity kept from pose a over b to c; see `factors.constant_velocity_factor`."""

    keys: tuple[int, int, int]
    kept: FloatArray
    """Shares of the motion from a to b that go on, GTSAM order, shape (6,)."""
    root_information: FloatArray
    """Upper triangular R of the noise, GTSAM order along the axes of c, shape (6, 6)."""
    robust: Robust = None
    """Kernel of the noise model."""
    dof: ClassVar[int] = 6
    landmark_keys: ClassVar[tuple[int, ...]] = ()

    def factor(self) -> gtsam.CustomFactor:
        """Make the factor, over its keys in their order."""
        return gtsam.CustomFactor(gaussian(self.root_information, self.robust, self.dof), list(self.keys), self._error)

    def expected(self, a_T_b: gtsam.Pose3) -> gtsam.Pose3:
        """b_T_c after a motion from a to b."""
        return gtsam.Pose3.Expmap(self.kept * gtsam.Pose3.Logmap(a_T_b))

    def rekeyed(self, names: Mapping[int, int], homes: Mapping[int, tuple[int, int]]) -> VelocityRecipe:
        """The same of other poses; see `factors.archive.rekeyed`."""
        a, b, c = (names.get(key, key) for key in self.keys)
        return replace(self, keys=(a, b, c))

    @staticmethod
    def of(plain: dict[str, Any]) -> VelocityRecipe:
        """Of its fields as JSON has them."""
        a, b, c = plain["keys"]
        robust = plain["robust"] and tuple(plain["robust"])
        return VelocityRecipe((a, b, c), np.array(plain["kept"]), np.array(plain["root_information"]), robust)

    def _error(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        """Tangent from where c is expected to c, along the axes of c, and its derivatives by the poses."""
        try:
            a, b, c = (values.atPose3(key) for key in self.keys)
        except RuntimeError as complaint:
            raise _NoValue(complaint, self) from complaint
        a_T_b, b_T_c = a.between(b), b.between(c)
        off = self.expected(a_T_b).between(b_T_c)
        if jacobians is not None:
            by_off = gtsam.Pose3.LogmapDerivative(off)
            moved = self.kept * gtsam.Pose3.Logmap(a_T_b)
            by_motion = gtsam.Pose3.ExpmapDerivative(moved) @ (self.kept[:, None] * gtsam.Pose3.LogmapDerivative(a_T_b))
            by_first = -by_off @ off.inverse().AdjointMap() @ by_motion
            jacobians[0] = -by_first @ a_T_b.inverse().AdjointMap()
            jacobians[1] = by_first - by_off @ b_T_c.inverse().AdjointMap()
            jacobians[2] = by_off
        return np.asarray(gtsam.Pose3.Logmap(off), dtype=np.float64)


class _NoValue(RuntimeError):
    """What GTSAM says where a variable has no value, and the recipe of the factor that asked for it."""

    def __init__(self, complaint: RuntimeError, recipe: Recipe | VelocityRecipe) -> None:
        super().__init__(*complaint.args)
        self.recipe = recipe


def describe(factor: gtsam.NonlinearFactor) -> Recipe | VelocityRecipe | None:
    """Recipe of a custom factor made here; None for anybody else's, and for native ones."""
    if not isinstance(factor, gtsam.CustomFactor):
        return None
    try:
        factor.unwhitenedError(gtsam.Values())
    except _NoValue as refusal:
        return refusal.recipe
    except Exception:  # somebody else's callback without values: whatever it throws, it is not one of ours
        return None
    return None


def _callback(recipe: Recipe) -> Callable[[gtsam.CustomFactor, gtsam.Values, Any], FloatArray]:
    kernel, data, landmark_keys = _kernel(recipe.kernel), recipe.data, recipe.landmark_keys
    at_home = recipe.pose_key == recipe.anchor_key
    pose_key, anchor_key = (None, None) if at_home else (recipe.pose_key, recipe.anchor_key)
    of_landmarks = [slice(12 + 3 * i, 15 + 3 * i) for i in range(len(landmark_keys))]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        try:
            landmarks = [values.atOrientedPlane3(key).planeCoefficients() for key in landmark_keys]
        except RuntimeError as complaint:
            raise _NoValue(complaint, recipe) from complaint
        world_T_body, of_body = _read(values, pose_key, 0, recipe.planar)
        world_T_anchor, of_anchor = _read(values, anchor_key, 6, recipe.planar)
        residual, derivative = kernel(world_T_anchor, world_T_body, *landmarks, *data)
        if jacobians is not None:
            for i, block in enumerate([*of_body, *of_anchor, *of_landmarks]):
                jacobians[i] = derivative[:, block]
        return residual

    return error


def _read(values: gtsam.Values, key: int | None, column: int, planar: bool) -> tuple[FloatArray, list[Any]]:
    """A pose, (4, 4), and its columns in the derivative of a kernel, the first of six given; the world has none."""
    if key is None:
        return IDENTITY, []
    pose = None if planar else held(values.atPose3, key)
    if pose is not None:
        return pose.matrix(), [slice(column, column + 6)]
    flat, matrix = values.atPose2(key), np.eye(4).T
    c, s = np.cos(flat.theta()), np.sin(flat.theta())
    matrix[0, 0], matrix[0, 1], matrix[0, 3] = c, -s, flat.x()
    matrix[1, 0], matrix[1, 1], matrix[1, 3] = s, c, flat.y()
    return matrix, [column + OF_POSE2]


@cache
def _kernel(name: str) -> _Kernel:
    """The compiled error of this name; an AttributeError for any other. Importing it takes numba, longer than GTSAM."""
    from factors import _kernels

    return getattr(_kernels, f"{name}_error")
