"""The value type of an uncertain plane."""

from __future__ import annotations

from dataclasses import dataclass

from shapely import Polygon

from spplanes._check import FloatArray, as_covariance, as_transform


@dataclass(frozen=True, eq=False)
class Plane:
    """An infinite plane with its uncertainty in the SPmodel, and the patch of it that was seen.

    The plane is z = 0 of `frame`; its normal is the frame's z axis. The perturbation is p = (z, theta, psi) in the
    plane's own frame: shift along z, rotation about y, rotation about x, composed on the right of `frame`. To first
    order the perturbed plane is z(x, y) = p_z - theta x + psi y.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, sections II and III.
    """

    frame: FloatArray
    """world_T_plane, shape (4, 4): origin at the weighted centre, x and y along the principal axes, z the normal."""
    covariance: FloatArray
    """Covariance of (z, theta, psi), shape (3, 3), m^2, m rad, rad^2."""
    n_points: int = 0
    """Number of points the plane was fitted to."""
    outline: Polygon | None = None
    """Boundary of the patch in plane coordinates (x, y), m; None when it was not computed."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", as_transform("frame", self.frame))
        object.__setattr__(self, "covariance", as_covariance("covariance", self.covariance, 3))

    @property
    def normal(self) -> FloatArray:
        """Unit normal, shape (3,)."""
        return self.frame[:3, 2]

    @property
    def d(self) -> float:
        """Hesse distance, m: n.x = d for every x on the plane."""
        return float(self.frame[:3, 2] @ self.frame[:3, 3])

    @property
    def centre(self) -> FloatArray:
        """Weighted centre of the points, shape (3,), m."""
        return self.frame[:3, 3]
