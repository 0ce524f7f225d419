"""A pose predicted in somebody's own graph: its estimate, and joint covariances wherever they come from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_key, as_keys, held, told_key
from factors.association.estimate import KeyedCovariance
from factors.isam import isam_covariance
from factors.landmarks import joint_covariance
from spplanes._check import FloatArray, as_covariance, check_instance


@dataclass(frozen=True, eq=False)
class Prediction:
    """A pose before its observations are in the graph, with the variables that they may touch.

    Made by `of_isam`, `of_marginals` or `of_matrix`. The pose is a ``gtsam.Pose3`` that is in the graph already, by
    odometry say; planes are ``gtsam.OrientedPlane3`` in the frame of an anchor pose or in the world. Covariances are in
    GTSAM's tangents at `values`.
    """

    pose_key: int
    """Key of the pose."""
    values: gtsam.Values
    """Estimates of the pose, of the landmarks and of their anchors."""
    marginal: Callable[[list[int]], FloatArray] = field(repr=False)
    """Joint covariance of variables in the order of their keys."""

    def __post_init__(self) -> None:
        check_instance("values", self.values, gtsam.Values)
        object.__setattr__(self, "values", gtsam.Values(self.values))  # the caller's go on changing
        key = as_key("pose_key", self.pose_key)
        if _size_of("pose_key", self.values, key) != 6:
            raise ValueError(f"pose_key: expected the key of a Pose3 in values, got {told_key(key)}, a plane")

    @classmethod
    def of_isam(cls, isam: gtsam.ISAM2, pose_key: int) -> Self:
        """By iSAM2: its estimate and its covariances, turned into the estimate's tangents as `isam_covariance` does.

        It holds until ``isam`` is updated: what is asked after that is refused. ValueError: no pose of that key.
        """
        check_instance("isam", isam, gtsam.ISAM2)
        values = isam.calculateEstimate()

        def marginal(keys: list[int]) -> FloatArray:
            if not values.equals(isam.calculateEstimate(), 1e-9):  # nothing was added to it since
                raise ValueError("prediction: expected that of isam as it is, got one from before its last update")
            return isam_covariance(isam, values, keys)

        return cls(pose_key, values, marginal)

    @classmethod
    def of_marginals(cls, marginals: gtsam.Marginals, values: gtsam.Values, pose_key: int) -> Self:
        """By ``gtsam.Marginals(graph, values)`` of the same values. ValueError: no pose of that key."""
        check_instance("marginals", marginals, gtsam.Marginals)
        return cls(pose_key, values, lambda keys: joint_covariance(marginals, keys))

    @classmethod
    def of_matrix(cls, covariance: ArrayLike, keys: Sequence[int], values: gtsam.Values, pose_key: int) -> Self:
        """By one joint covariance of the pose and whatever landmarks and anchors it may be compared with.

        Args:
            covariance: of the stacked tangents, 6 numbers a pose (rotation, translation) and 3 a plane, shape (D, D).
                A map that is taken as known exactly has rows of nought: they have to be said.
            keys: the variables, in the order of the rows.
            values: their estimates.
            pose_key: the pose.

        Raises:
            ValueError: another shape, NaN, no symmetric positive semidefinite matrix, keys given twice or not in
                values, the pose not among them.
        """
        check_instance("values", values, gtsam.Values)
        names = as_keys("keys", keys)
        if as_key("pose_key", pose_key) not in names:
            raise ValueError(f"keys: expected the pose {told_key(pose_key)} among them, got {_told(names)}")
        sizes = [_size_of("keys", values, key) for key in names]
        known = KeyedCovariance(names, as_covariance("covariance", covariance, sum(sizes)), sizes)

        def marginal(wanted: list[int]) -> FloatArray:
            missing = [key for key in wanted if key not in names]
            if missing:
                raise ValueError(f"keys: expected all landmarks and anchors compared, got none of {_told(missing)}")
            return known.of(wanted)

        return cls(pose_key, values, marginal)

    def pose(self, key: int, /) -> FloatArray:
        """world_T_body of a pose, shape (4, 4)."""
        return self.values.atPose3(key).matrix()

    def plane(self, key: int, /) -> gtsam.OrientedPlane3:
        """A plane landmark, in the frame that it lives in."""
        return self.values.atOrientedPlane3(key)

    def values_of(self, keys: Sequence[int], /) -> gtsam.Values:
        """All values."""
        return self.values

    def covariance(self, key: int, /) -> FloatArray:
        """Marginal covariance of one variable."""
        return self.joint_covariance([key]).full

    def joint_covariance(self, keys: Sequence[int], /) -> KeyedCovariance:
        """Joint marginal covariance of some variables. ValueError: the graph leaves one of them open."""
        sizes = [_size_of("keys", self.values, key) for key in keys]
        full = self.marginal(list(keys))
        if not np.isfinite(full).all():
            raise ValueError("prediction: expected finite covariances, got NaN or infinity: the graph is not solved")
        return KeyedCovariance(keys, full, sizes)


def _size_of(name: str, values: gtsam.Values, key: int) -> int:
    """Numbers in the tangent of a pose or a plane."""
    for read, size in ((values.atPose3, 6), (values.atOrientedPlane3, 3)):
        if held(read, key) is not None:
            return size
    raise ValueError(f"{name}: expected the key of a Pose3 or an OrientedPlane3 in values, got {told_key(key)}")


def _told(keys: Sequence[int]) -> str:
    return ", ".join(told_key(key) for key in keys) or "none"
