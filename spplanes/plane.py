"""The value type of an uncertain plane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import (
    FloatArray,
    as_count,
    as_covariance,
    as_float_array,
    as_number,
    as_shape,
    as_transform,
    check_instance,
    read_only,
)
from spplanes._hesse import covariance_from_hesse, frame_from_hesse, hesse_jacobian, slopes_in
from spplanes._rows import OK, ROW_SIZE, merge_rows, row_frame
from spplanes.spmodel import Location, chi2_of

if TYPE_CHECKING:
    from shapely import Polygon


@dataclass(frozen=True, eq=False)
class Plane:
    """An infinite plane with its uncertainty in the SPmodel, and the patch of it that was seen.

    The plane is z = 0 of `frame`; its normal is the frame's z axis. The perturbation is p = (z, theta, psi) in the
    plane's own frame: shift along z, rotation about y, rotation about x, composed on the right of `frame`. To first
    order the perturbed plane is z(x, y) = p_z - theta x + psi y.

    A value: planes with the same numbers and outline are equal, and its arrays are read-only.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, sections II and III.
    """

    frame: FloatArray
    """world_T_plane, shape (4, 4): origin at the weighted centre, x and y along the principal axes, z the normal."""
    covariance: FloatArray
    """Covariance of (z, theta, psi), shape (3, 3), m^2, m rad, rad^2."""
    n_points: int = 0
    """Number of points the plane was fitted to; with a robust fit, of those it did not reject."""
    outline: Polygon | None = None
    """Boundary of the patch in plane coordinates (x, y), m; None when it was not computed."""
    chi2: float = 0.0
    """Sum of the squared normalised residuals of the fit, n_points - 3 on average; 0 when it was not computed."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", read_only(as_transform("frame", self.frame).copy()))
        object.__setattr__(self, "covariance", read_only(as_covariance("covariance", self.covariance, 3).copy()))
        object.__setattr__(self, "n_points", as_count("n_points", self.n_points))
        object.__setattr__(self, "chi2", as_number("chi2", self.chi2))
        if self.outline is not None and getattr(self.outline, "geom_type", None) != "Polygon":
            raise ValueError(f"outline: expected a shapely Polygon or None, got {type(self.outline).__name__}")

    @classmethod
    def _trusted(
        cls, frame: FloatArray, covariance: FloatArray, n_points: int, outline: Polygon | None = None, chi2: float = 0.0
    ) -> Self:
        """A plane from values that are known to be good, without checking them again."""
        plane = object.__new__(cls)
        values = {"frame": frame, "covariance": covariance, "n_points": n_points, "outline": outline, "chi2": chi2}
        plane.__setstate__(values)
        return plane

    def __setstate__(self, state: dict[str, Any]) -> None:
        """What it is made of, from a pickle too, which does not keep arrays from being written to."""
        self.__dict__.update(state)
        self.__dict__.update(frame=read_only(state["frame"]), covariance=read_only(state["covariance"]))

    def __eq__(self, other: object) -> bool:
        """Whether frame, covariance, points, chi2 and outline are the same, to the bit."""
        if not isinstance(other, Plane):
            return NotImplemented
        return (
            self.n_points == other.n_points
            and self.chi2 == other.chi2
            and np.array_equal(self.frame, other.frame)
            and np.array_equal(self.covariance, other.covariance)
            and self.outline == other.outline
        )

    def __hash__(self) -> int:
        return hash((self.n_points, *self.centre.tolist()))

    @classmethod
    def from_hesse(
        cls, normal: ArrayLike, d: float, covariance: ArrayLike, *, centre: ArrayLike | None = None, n_points: int = 0
    ) -> Self:
        """The plane normal.x = d.

        Args:
            normal: unit normal, shape (3,), to 1e-6.
            d: Hesse distance, m.
            covariance: of (normal, d), shape (4, 4), the part along the normal being ignored; or of (z, theta, psi) in
                the frame this function makes, shape (3, 3).
            centre: the frame's origin is its foot on the plane, shape (3,), m; by default the world's origin's.
            n_points: number of points behind the plane.

        Raises:
            ValueError: a normal that is not of unit length, or a covariance of another shape or not semidefinite.
        """
        frame = frame_from_hesse(as_shape("normal", normal, (3,)), as_number("d", d), centre)
        if np.shape(covariance) == (4, 4):
            covariance = covariance_from_hesse(frame, as_covariance("covariance", covariance, 4))
        return cls(frame, as_covariance("covariance", covariance, 3), n_points)

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

    @property
    def hesse_covariance(self) -> FloatArray:
        """Covariance of (normal, d), shape (4, 4), of rank 3: the normal has no error along itself."""
        jacobian = hesse_jacobian(self.frame)
        return jacobian @ self.covariance @ jacobian.T

    @property
    def location(self) -> Location:
        """The plane as an object of the SPmodel."""
        return Location.plane(self.frame, self.covariance)

    def distance(self, points: ArrayLike) -> FloatArray:
        """Signed distance of ``points`` (N, 3) or (3,) from the plane, m, shape (N,) or (); positive on n's side."""
        return (_points(points) - self.centre) @ self.normal

    def project(self, points: ArrayLike) -> FloatArray:
        """Feet of ``points`` (N, 3) or (3,) on the plane, in the same frame and shape, m."""
        array = _points(points)
        return array - self.distance(array)[..., None] * self.normal

    def transform(self, transform: ArrayLike, covariance: ArrayLike | None = None) -> Self:
        """The plane seen from another frame: ``transform`` is other_T_this, (4, 4).

        Args:
            transform: rigid transform from the frame the plane is in to the new one.
            covariance: (6, 6) of the differential (x, y, z, phi, theta, psi) of ``transform``, composed on its right,
                i.e. expressed in the frame the plane is in now; without it the transform is exact.
        """
        matrix = as_transform("transform", transform)
        moved = self.covariance
        if covariance is not None:
            moved = Location.pose(matrix, covariance).compose(self.location).covariance
        return type(self)._trusted(matrix @ self.frame, moved, self.n_points, self.outline, self.chi2)

    def merge(self, other: Plane) -> Self:
        """The plane of both planes' points, in information form: what merging their moments gives.

        The information of a plane, C^-1, is that of weighted points lying in it; with the residual chi2 along the
        normal these are its moments. They are added and the plane is read off again. The normal keeps this plane's
        side. The outline is dropped: it is not a matter of moments.

        Raises:
            ValueError: one of the two covariances is singular, or the normals are more than 90 deg apart.
        """
        check_instance("other", other, Plane)
        if self.normal @ other.normal <= 0.0:
            raise ValueError("other: expected a plane seen from the same side, got normals 90 deg apart or more")
        merged, frame, values = np.empty(ROW_SIZE), np.empty((4, 4)), np.empty(3)
        merge_rows(self._moment_row("self"), other._moment_row("other"), merged)
        eye = merged[2:5] + self.normal * (1.0 + np.abs(merged[2:5]).max())
        merged[0] = max(merged[0], 3.0)
        if row_frame(merged, eye, frame, values) != OK:
            raise ValueError("other: expected a plane with finite information, got a degenerate one")
        covariance = np.diag([1.0 / merged[1], 1.0 / values[2], 1.0 / values[1]])
        return type(self)._trusted(frame, covariance, self.n_points + other.n_points, chi2=float(values[0]))

    def mahalanobis(self, other: Plane) -> float:
        """Squared Mahalanobis distance of two independent planes of the same world: chi2 with 3 degrees of freedom.

        Both are written as z(x, y) = p_z - theta x + psi y in one frame, midway between their centres and normals, so
        that frames and principal axes do not matter and the distance is symmetric. Planes whose normals are 90 deg
        apart or more are seen from opposite sides: the distance is infinite. So it is when they differ in a direction
        in which both are certain.
        """
        check_instance("other", other, Plane)
        bisector = self.normal + other.normal
        if self.normal @ other.normal <= 0.0:
            return np.inf
        middle = frame_from_hesse(bisector / np.linalg.norm(bisector), 0.0, None)
        middle[:3, 3] = 0.5 * (self.centre + other.centre)
        here, cov_here = slopes_in(middle, self.frame, self.covariance)
        there, cov_there = slopes_in(middle, other.frame, other.covariance)
        return chi2_of(here - there, cov_here + cov_there)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, as in ``planes.json``; floats survive a round trip through JSON exactly.

        The outline is a list of rings of [x, y], the exterior first, then the holes, each closed.
        """
        outline = None
        if self.outline is not None and not self.outline.is_empty:
            rings = self.outline.exterior, *self.outline.interiors
            outline = [[[x, y] for x, y, *_ in ring.coords] for ring in rings]
        return {
            "normal": self.normal.tolist(),
            "d": self.d,
            "frame": self.frame.tolist(),
            "covariance": self.covariance.tolist(),
            "n_points": int(self.n_points),
            "chi2": float(self.chi2),
            "outline": outline,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The plane of a dict made by `to_dict`; unknown keys are ignored.

        Raises:
            ValueError: a key is missing or holds something else, or normal and d contradict the frame.
        """
        if not isinstance(data, dict):
            raise ValueError(f"data: expected a dict, got {type(data).__name__}")
        missing = [key for key in ("normal", "d", "frame", "covariance", "n_points") if key not in data]
        if missing:
            raise ValueError(f"data: expected the key {missing[0]!r}, got {sorted(map(str, data))}")
        covariance = as_shape("covariance", data["covariance"], (3, 3))
        plane = cls(data["frame"], covariance, data["n_points"], _polygon(data.get("outline")), data.get("chi2", 0.0))
        # normal and d are written for readers of the file; the frame is what counts, and they must agree with it
        normal, d = as_shape("normal", data["normal"], (3,)), as_number("d", data["d"])
        if np.abs(normal - plane.normal).max() > 1e-6:
            raise ValueError(f"normal: expected the frame's z axis {plane.normal.tolist()}, got {normal.tolist()}")
        if abs(d - plane.d) > 1e-6 * max(1.0, float(np.abs(plane.centre).max())):
            raise ValueError(f"d: expected the frame's distance {plane.d}, got {d}")
        return plane

    def _moment_row(self, name: str) -> FloatArray:
        """Moment row of in-plane points with this plane's information, and its chi2 along the normal."""
        try:
            information = np.linalg.inv(self.covariance)
        except np.linalg.LinAlgError as error:
            raise ValueError(f"{name}: expected a plane with a regular covariance, got a singular one") from error
        weight = information[0, 0]
        if not (np.isfinite(information).all() and weight > 0.0):
            raise ValueError(f"{name}: expected a covariance that can be inverted, got {self.covariance[0].tolist()}")
        x, y = -information[0, 1] / weight, information[0, 2] / weight
        spread = np.array(
            [
                [information[1, 1] - weight * x * x, -information[1, 2] - weight * x * y],
                [-information[1, 2] - weight * x * y, information[2, 2] - weight * y * y],
            ]
        )
        axes = self.frame[:3, :2]
        scatter = axes @ spread @ axes.T + self.chi2 * np.outer(self.normal, self.normal)
        centre = self.centre + axes @ (x, y)
        return np.concatenate(([self.n_points, weight], centre, scatter[np.triu_indices(3)]))


def _points(value: ArrayLike) -> FloatArray:
    """Points (N, 3) or (3,), NaN allowed."""
    points = as_float_array("points", value)
    if points.ndim not in (1, 2) or points.shape[-1] != 3:
        raise ValueError(f"points: expected shape (N, 3) or (3,), got {points.shape}")
    return points


def _polygon(rings: Any) -> Polygon | None:
    if rings is None:
        return None
    from shapely import Polygon  # a slow import that most fits never need

    if not isinstance(rings, (list, tuple)) or not rings:
        raise ValueError(f"outline: expected a list of rings, got {type(rings).__name__}")
    arrays = [as_shape("outline", ring, (None, 2)) for ring in rings]
    if min(len(ring) for ring in arrays) < 4:
        raise ValueError("outline: expected closed rings of at least 4 points, got a shorter one")
    polygon = Polygon(arrays[0], arrays[1:])
    if not polygon.is_valid:
        raise ValueError("outline: expected a valid polygon, got one that crosses itself")
    return polygon
