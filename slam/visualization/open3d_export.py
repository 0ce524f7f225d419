"""Maps as Open3D geometry: planes as a mesh, outlines, trajectory, confidence as lines, points coloured by plane.

Every function returns legacy geometry (``open3d.geometry``), or with ``tensor=True`` tensor geometry
(``open3d.t.geometry``), which also carries the landmark's id as attribute "plane" and, on meshes, the standard
deviation along the normal as "sigma_m". Nothing here opens a window. ImportError: Open3D is not there.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv
from shapely import Polygon, box

from slam.errors import optional
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.visualization.mesh import Mesh, chains_of, colour_of, mesh_of
from spplanes import Plane
from spplanes._check import FloatArray, as_covariance_stack, as_float_array, as_positive, as_shape

ColourBy = Literal["plane", "sigma"]


def planes_to_mesh(
    planes: Sequence[MapPlane | Plane] | MapPlane | Plane | Any,
    *,
    colour_by: ColourBy = "plane",
    sigma_limit_m: float | None = None,
    tensor: bool = False,
) -> Any:
    """Triangle mesh of the outlines, holes left open, counter-clockwise seen from the side a plane was seen from.

    Args:
        planes: of a map, or fitted ones, or one of them, or what has `planes` such as a `Run`. Of fitted ones the id is
            their place in the sequence. One without an outline is drawn as the rectangle with the rms extents of its
            points, which its covariance tells; of one without points either nothing can be drawn, and a warning says so
            (``fit_plane(..., outline=True)`` and ``world_plane(..., shape_of=...)`` give outlines).
        colour_by: "plane": floor and ceiling grey, walls by direction. "sigma": the standard deviation of the plane's
            height over its own patch, at each corner, from dark blue (0) to yellow. Between corners the renderer
            interpolates; the deviation is convex in (x, y), so what it shows is never too small.
        sigma_limit_m: standard deviation that gets the last colour, m; None: the largest in the mesh.
        tensor: ``open3d.t.geometry.TriangleMesh`` in place of ``open3d.geometry.TriangleMesh``.

    Raises:
        ValueError: an unknown ``colour_by``, or a limit that is not positive.
    """
    o3d = _open3d()
    shown = _as_map_planes(planes)
    mesh = mesh_of(shown)
    sigmas = vertex_sigmas(shown, mesh)
    if colour_by not in ("plane", "sigma"):
        raise ValueError(f"colour_by: expected 'plane' or 'sigma', got {colour_by!r}")
    colours = mesh.colours / 255.0
    if colour_by == "sigma":
        from matplotlib import colormaps

        most = float(sigmas.max(initial=0.0)) or 1.0
        most = most if sigma_limit_m is None else as_positive("sigma_limit_m", sigma_limit_m)
        colours = colormaps["viridis"](np.minimum(sigmas / most, 1.0))[:, :3]
    result = o3d.t.geometry.TriangleMesh()
    result.vertex.positions, result.triangle.indices = _tensor(mesh.vertices), _tensor(mesh.triangles)
    result.vertex.normals, result.vertex.colors = _tensor(mesh.normals), _colours(colours, tensor)
    result.vertex["plane"] = _tensor(mesh.plane_ids[:, None])
    result.vertex["sigma_m"] = _tensor(sigmas[:, None])
    return result if tensor else result.to_legacy()


def outlines_to_lines(planes: Sequence[MapPlane | Plane], *, tensor: bool = False) -> Any:
    """Line set of all rings of the outlines, and of the segments where only lines were seen, coloured by plane.

    Planes and errors are as of `planes_to_mesh`; ``tensor``: ``open3d.t.geometry.LineSet``.
    """
    drawn = [(plane, chain) for plane in _as_map_planes(planes) for chain in chains_of(plane)]
    colours = np.array([colour_of(plane) for plane, _ in drawn]) / 255.0
    return _line_set([chain for _, chain in drawn], colours, [plane.id for plane, _ in drawn], tensor)


def trajectory_to_lines(
    trajectory: Trajectory | FloatArray | Sequence[Any],
    *,
    rgb: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tensor: bool = False,
) -> Any:
    """Line set through the positions of a trajectory in one colour, RGB in 0..1; `tensor` as in `outlines_to_lines`.

    ``trajectory`` is a `Trajectory` or what has one such as a `Run`, poses of shape (N, 4, 4), positions of shape
    (N, 3), or a sequence of ``gtsam.Pose3``. ValueError: something else.
    """
    positions = _positions_of(getattr(trajectory, "trajectory", trajectory))
    return _line_set([positions], [rgb], None, tensor)


def ellipsoids_to_lines(
    centres: ArrayLike,
    covariances: ArrayLike,
    *,
    confidence: float = 0.95,
    scale: float = 1.0,
    rgb: tuple[float, float, float] = (0.2, 0.4, 0.9),
    tensor: bool = False,
) -> Any:
    """Confidence ellipsoids of positions, each as three great ellipses in its principal planes.

    The positions of a run and their covariances in the world are what
    `slam.visualization.pictures.position_covariances` gives.

    Args:
        centres: shape (N, 3), m.
        covariances: of each, shape (N, 3, 3), m^2; semidefinite ones are flat.
        confidence: probability that a position lies inside, 3 degrees of freedom.
        scale: enlarges every ellipsoid by this factor, so that millimetres can be seen in a corridor.
        rgb: colour, in 0..1.
        tensor: ``open3d.t.geometry.LineSet``, whose attribute "plane" is the number of the ellipsoid.

    Raises:
        ValueError: wrong shapes, a covariance that is not positive semidefinite, a confidence outside (0, 1), or a
            scale that is not positive.
    """
    points = as_shape("centres", centres, (None, 3))
    matrices = as_covariance_stack("covariances", covariances, 3, len(points))
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence: expected a probability between 0 and 1, got {confidence}")
    reach = as_positive("scale", scale) * np.sqrt(2.0 * gammaincinv(0.5 * 3, confidence))
    turns = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.column_stack((np.zeros_like(turns), np.cos(turns), np.sin(turns)))
    circles = np.stack([np.roll(circle, axis, axis=1) for axis in range(3)])  # round each axis
    chains = []
    for centre, values, vectors in zip(points, *np.linalg.eigh(matrices), strict=True):
        axes = reach * np.sqrt(np.maximum(values, 0.0)) * vectors
        chains += list(circles @ axes.T + centre)
    return _line_set(chains, [rgb] * len(chains), np.repeat(np.arange(len(points)), 3), tensor)


def points_to_cloud(points: ArrayLike, labels: ArrayLike | None = None, *, tensor: bool = False) -> Any:
    """Point cloud of the points that are returns, coloured by plane; grey where there is none.

    Args:
        points: shape (..., 3), m, or what has such points, as a `slam.io.clouds.Cloud`; those not finite are left out.
        labels: plane of each point as `spplanes.segment_scans` gives it, shape (...,), integers, negative = none.
        tensor: ``open3d.t.geometry.PointCloud`` with the attribute "plane" in place of the legacy one.

    Raises:
        ValueError: points of another shape, or labels that are not one integer per point.
    """
    o3d = _open3d()
    array = as_float_array("points", getattr(points, "points", points))
    if array.ndim < 1 or array.shape[-1] != 3:
        raise ValueError(f"points: expected shape (..., 3), got {array.shape}")
    numbers = np.full(array.shape[:-1], -1) if labels is None else np.asarray(labels)
    if numbers.shape != (shape := array.shape[:-1]) or numbers.dtype.kind not in "iu":
        raise ValueError(f"labels: expected integers of shape {shape}, got {numbers.dtype} of {numbers.shape}")
    seen = np.isfinite(array).all(axis=-1)
    kept, plane = array[seen], numbers[seen].astype(np.int32)
    result = o3d.t.geometry.PointCloud(_tensor(kept))
    result.point.colors, result.point["plane"] = _colours(label_colours(plane), tensor), _tensor(plane[:, None])
    return result if tensor else result.to_legacy()


def vertex_sigmas(planes: Sequence[MapPlane], mesh: Mesh) -> FloatArray:
    """Standard deviation of each corner of a mesh of these planes along its plane's normal, shape (V,), m.

    The height of a perturbed plane is p_z - theta x + psi y, so its variance at (x, y) is h C h^T, h = (1, -x, y).
    """
    sigmas = np.zeros(len(mesh.vertices))
    for plane in planes:
        mine = mesh.plane_ids == plane.id
        x, y = ((mesh.vertices[mine] - plane.plane.centre) @ plane.plane.frame[:3, :2]).T
        slopes = np.column_stack((np.ones(len(x)), -x, y))
        variances = np.einsum("ni,ij,nj->n", slopes, plane.plane.covariance, slopes)
        sigmas[mine] = np.sqrt(np.maximum(variances, 0.0))
    return sigmas


def label_colours(labels: np.ndarray) -> FloatArray:
    """One colour per label, shape (N, 3), RGB in 0..1, the same for equal labels in every call; grey where negative."""
    from matplotlib.colors import hsv_to_rgb

    hues = labels * 0.6180339887498949 % 1.0  # by the golden ratio: neighbours in a list are far apart in colour
    colours = hsv_to_rgb(np.column_stack((hues, np.full(len(labels), 0.75), np.full(len(labels), 0.9))))
    return np.where((labels < 0)[:, None], 0.6, colours)


def _as_map_planes(given: Any) -> list[MapPlane]:
    """One plane, several, or what has `planes`: those of a map as they are, fitted ones with what is known of them."""
    found = getattr(given, "planes", given)
    found = [found] if isinstance(found, MapPlane | Plane) else found
    planes = list(found) if isinstance(found, Iterable) and not isinstance(found, str | np.ndarray) else [given]
    for wrong in planes:
        if not isinstance(wrong, MapPlane | Plane):
            wanted = "a Plane or MapPlane, several of them, or what has planes such as a Run"
            raise ValueError(f"planes: expected {wanted}, got {type(wrong).__name__}")
    result = []
    for index, plane in enumerate(planes):
        if isinstance(plane, MapPlane):
            result.append(plane)
        elif plane.outline is not None or plane.n_points >= 3:  # less were never fitted
            result.append(MapPlane(index, plane, plane.outline or _rectangle_of(plane), 1, ("plane",)))
    if empty := len(planes) - len(result):
        warnings.warn(
            f"planes: {empty} of {len(planes)} have neither an outline nor points, and are not drawn; "
            "fit_plane(..., outline=True) and world_plane(..., shape_of=...) give outlines",
            stacklevel=3,
        )
    return result


def _positions_of(trajectory: Any) -> FloatArray:
    """Positions (N, 3) of poses, or of positions."""
    poses = trajectory.poses if isinstance(trajectory, Trajectory) else trajectory
    if not hasattr(poses, "__len__"):
        wanted = "a Trajectory, poses (N, 4, 4), positions (N, 3) or Pose3s"
        raise ValueError(f"trajectory: expected {wanted}, got {type(poses).__name__}")
    if not len(poses):
        return np.empty((0, 3))
    if np.ndim(poses) == 2 and np.shape(poses)[1] == 3:
        return as_shape("trajectory", poses, (None, 3))
    return as_shape("trajectory", poses, (None, 4, 4))[:, :3, 3]


def _rectangle_of(plane: Plane) -> Polygon:
    """Rectangle with the rms extents of a plane's points.

    Of N points of equal noise s the covariance is s^2 (1 / N, 1 / sum x^2, 1 / sum y^2): the mean square of x is
    C_zz / C_theta theta, and that of y is C_zz / C_psi psi. A rectangle of half side h has h^2 / 3.
    """
    variances = np.diag(plane.covariance)
    x, y = np.sqrt(3.0 * variances[0] / variances[1:])
    return box(-x, -y, x, y)


def _line_set(chains: Sequence[FloatArray], colours: ArrayLike, ids: ArrayLike | None, tensor: bool) -> Any:
    """Chains of corners (N, 3) as a line set; the lines of each have its colour and its id."""
    o3d = _open3d()
    points = np.concatenate([np.empty((0, 3)), *chains])
    starts = np.cumsum([0, *(len(chain) for chain in chains)])
    pairs = [np.arange(a, b - 1)[:, None] + [0, 1] for a, b in pairwise(starts) if b - a > 1]
    lines = np.concatenate([np.empty((0, 2), dtype=np.int32), *pairs]).astype(np.int32)
    result = o3d.t.geometry.LineSet()
    result.point.positions, result.line.indices = _tensor(points), _tensor(lines)
    of_line = np.repeat(np.arange(len(chains)), [max(len(chain) - 1, 0) for chain in chains])
    result.line.colors = _colours(np.asarray(colours, dtype=np.float64).reshape(-1, 3)[of_line], tensor)
    if ids is not None:
        result.line["plane"] = _tensor(np.asarray(ids, dtype=np.int32)[of_line, None])
    return result if tensor else result.to_legacy()


def _colours(rows: FloatArray, tensor: bool) -> Any:
    """RGB (N, 3) in 0..1: tensor geometry has single precision, legacy geometry double."""
    return _tensor(rows, np.float32 if tensor else np.float64)


def _tensor(array: np.ndarray, dtype: type[np.generic] | None = None) -> Any:
    return _open3d().core.Tensor(np.ascontiguousarray(array, dtype=dtype))


def _open3d() -> Any:
    library = ", and the system library libusb-1.0 (Debian, Ubuntu: apt-get install libusb-1.0-0)"
    return optional("open3d", library)
