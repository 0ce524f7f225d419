"""Surface elements of a 3D scan: a thinned copy of all its returns with normals, for registration by all returns.

Planes alone leave a view open that sees only two directions, and clutter is on no plane. Three kinds of elements say
what a scan saw, each a point with a direction in which it is known:

- on a plane: the point projected onto it, with the plane's normal. Small patches of a camera's image of a plane have
  normals of their own that turn with the camera, not with the world.
- on no plane, but flat in the small: its own normal.
- on an edge before something farther: known across the edge, at a right angle to the line of sight.

References:
    Choi, Trevor, Christensen, "RGB-D edge detection and edge-based registration", IROS 2013, for occluding edges.
    Behley, Stachniss, "Efficient surfel-based SLAM using 3D laser range data in urban environments", RSS 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slam.geometry.frames import lift
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray

#: Kinds of elements, as they are stored.
ON_PLANE, ON_NO_PLANE, ON_EDGE = 0, 1, 2
#: Columns of stored elements: point, direction, standard deviation along it, kind.
COLUMNS = 8
#: Width of an element as a share of its range, rounded down to a power of two metres: it is seen 1 to 2 deg wide.
_SHARE = 0.03
#: On planes, where a few say as much as many, so wide.
_SHARE_ON_PLANE = 0.06
#: Fewest points of an element on a plane, and of one whose direction its own points tell.
_LEAST_ON_PLANE, _LEAST = 3, 6
#: An element's own points tell a direction when its second extent is this share of the first (variances), its
#: thickness that of the second, and it is seen steeper than this (sine).
_BROAD, _FLAT, _STEEP = 0.1, 0.1, 0.15
#: Grids with more points than this are thinned evenly before elements are made of them.
_MOST_POINTS = 80_000
#: Between the two sides of an edge there is no return over at most this angle, rad: what casts a shadow hides it.
_GAP_RAD = 0.08
#: What lies behind an edge is farther by this, m, by this share of the range, and by this many times the step before.
_BEHIND_M, _BEHIND_SHARE, _BEHIND_STEPS = 0.1, 0.04, 4.0
#: Points within this share of the range of each other tell the direction of an edge; it is straight when their second
#: extent is at most this share of the first (variances).
_ALONG_SHARE, _STRAIGHT = 0.05, 0.05
#: Edges are taken so far inside, rad, in whole beams, where returns are of the near side alone: the pixels of a camera
#: blur two sides into one.
_INSET_RAD = 0.004


@dataclass(frozen=True, eq=False)
class _Cells:
    """Points gathered in cubes whose width grows with the range."""

    mean: FloatArray
    """Shape (N, 3), m."""
    covariance: FloatArray
    """Scatter of the points, shape (N, 3, 3), m^2."""
    count: np.ndarray
    """Points, shape (N,)."""
    label: np.ndarray
    """Of its points, shape (N,)."""

    @classmethod
    def of(cls, points: FloatArray, labels: np.ndarray, share: float) -> _Cells:
        """Points (N, 3), seen from the origin, with labels (N,) that are kept apart."""
        level = np.floor(np.log2(share * np.maximum(np.linalg.norm(points, axis=1), 1e-3)))
        cell = np.floor(points / np.exp2(level)[:, None])
        key = np.column_stack((level, labels, cell)).astype(np.int64)
        key -= key.min(axis=0)
        sizes = key.max(axis=0) + 1
        number = np.zeros(len(key), dtype=np.int64)
        for column, size in zip(key.T, sizes.tolist(), strict=True):
            number = number * size + column
        _, first, inverse, count = np.unique(number, return_index=True, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(inverse, points[:, a]) for a in range(3)], axis=1) / count[:, None]
        off = points - mean[inverse]
        scatter = np.empty((len(count), 3, 3))
        for a in range(3):
            for b in range(a, 3):
                scatter[:, a, b] = scatter[:, b, a] = np.bincount(inverse, off[:, a] * off[:, b]) / count
        return cls(mean, scatter, count, labels[first])

    def only(self, chosen: np.ndarray) -> _Cells:
        """Those of a mask (N,)."""
        return _Cells(self.mean[chosen], self.covariance[chosen], self.count[chosen], self.label[chosen])


def surfaces_of(points: FloatArray, labels: np.ndarray, planes: FloatArray, sensor: Sensor) -> FloatArray:
    """Surface elements of a scan in the body frame, rows (point, direction, sigma, kind), shape (N, 8).

    Args:
        points: in the sensor's frame, shape (S, B, 3), m; NaN = no return.
        labels: plane of every point, shape (S, B); -1: none.
        planes: rows (normal, d) by label, n.x = d, shape (P, 4).
        sensor: how it errs, and where it sits.
    """
    every = int(np.ceil(np.sqrt(max(np.isfinite(points[..., 0]).sum() / _MOST_POINTS, 1.0))))
    thin, thin_labels = points[::every, ::every].reshape(-1, 3), labels[::every, ::every].ravel()
    seen = np.isfinite(thin).all(axis=1)
    flat, rest = seen & (thin_labels >= 0), seen & (thin_labels < 0)
    parts = [_on_edges(points, labels, sensor)]
    if flat.any():
        parts.append(_on_planes(_Cells.of(thin[flat], thin_labels[flat], _SHARE_ON_PLANE), planes, sensor))
    if rest.any():
        parts.append(_on_no_plane(_Cells.of(thin[rest], np.zeros(rest.sum(), dtype=np.int64), _SHARE), sensor))
    rows = np.concatenate(parts)
    rows[:, 6] = np.hypot(rows[:, 6], sensor.surface_sigma_m * np.sqrt(_crowding(rows, sensor.surface_correlation_m)))
    turned = rows[:, 3:6] @ sensor.body_T_sensor[:3, :3].T
    return np.column_stack((lift(rows[:, :3], sensor.body_T_sensor), turned, rows[:, 6:]))


def _on_planes(cells: _Cells, planes: FloatArray, sensor: Sensor) -> FloatArray:
    some = cells.only(cells.count >= _LEAST_ON_PLANE)
    normals, d = planes[some.label, :3], planes[some.label, 3]
    points = some.mean - (np.einsum("ki,ki->k", some.mean, normals) - d)[:, None] * normals
    return _rows(points, normals, _sigma(some, sensor), ON_PLANE)


def _on_no_plane(cells: _Cells, sensor: Sensor) -> FloatArray:
    some = cells.only(cells.count >= _LEAST)
    values, vectors = np.linalg.eigh(some.covariance)
    normals = vectors[:, :, 0]
    along = np.einsum("ki,ki->k", normals, some.mean) / np.maximum(np.linalg.norm(some.mean, axis=1), 1e-9)
    normals = normals * np.where(along > 0.0, -1.0, 1.0)[:, None]  # toward the sensor
    flat = (values[:, 1] > _BROAD * values[:, 2]) & (values[:, 0] < _FLAT * values[:, 1]) & (np.abs(along) > _STEEP)
    some = some.only(flat)
    return _rows(some.mean, normals[flat], _sigma(some, sensor), ON_NO_PLANE)


def _sigma(cells: _Cells, sensor: Sensor) -> FloatArray:
    """Standard deviation of the mean of each cell along its direction, (N,), m."""
    variance = sensor.range_variance_at(np.linalg.norm(cells.mean, axis=1))
    return np.sqrt(variance / np.maximum(cells.count, 1))


def _on_edges(points: FloatArray, labels: np.ndarray, sensor: Sensor) -> FloatArray:
    """Edges before something farther: known across the edge and across the line of sight, to a beam or so."""
    width = _beam_width(points)
    inset = round(_INSET_RAD / width) if width > 0.0 else 0
    ways = (points, labels), (points.transpose(1, 0, 2), labels.T)
    found = np.unique(np.concatenate([_edge_points(*one, inset) for one in ways]), axis=0)
    if len(found) < _LEAST:
        return np.empty((0, COLUMNS))
    seeds = _Cells.of(found, np.zeros(len(found), dtype=np.int64), 0.5 * _SHARE).mean
    mean, scatter = _neighbourhoods(seeds, found)
    values, vectors = np.linalg.eigh(scatter)
    across = np.cross(mean, vectors[:, :, 2])
    ranges, length = np.linalg.norm(mean, axis=1), np.linalg.norm(across, axis=1)
    straight = (values[:, 1] < _STRAIGHT * values[:, 2]) & (length > 0.5 * ranges)
    mean, across = mean[straight], across[straight] / length[straight, None]
    return _rows(mean, across, width * ranges[straight], ON_EDGE)


def _neighbourhoods(seeds: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (N, 3) and scatter (N, 3, 3) of the points about each seed that has enough of them."""
    reaches = _ALONG_SHARE * np.linalg.norm(seeds, axis=1)
    members = [np.sort(one) for one in cKDTree(points).query_ball_point(seeds, reaches)]
    groups = [points[one] for one in members if len(one) >= _LEAST]
    if not groups:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    return np.array([group.mean(axis=0) for group in groups]), np.array([np.cov(group.T) for group in groups])


def _beam_width(points: FloatArray) -> float:
    """Angle between neighbouring beams of a grid, the larger of rows and columns, rad."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    widths = [np.linalg.norm(np.diff(rays, axis=axis), axis=-1) for axis in (0, 1)]
    return max((float(np.nanmedian(one)) for one in widths if np.isfinite(one).any()), default=0.0)


def _edge_points(points: FloatArray, labels: np.ndarray, inset: int) -> FloatArray:
    """Points (N, 3) on the near side of jumps along the rows of a grid (S, B, 3), both ways."""
    both = (points, labels), (points[:, ::-1], labels[:, ::-1])
    return np.concatenate([_edges_ahead(*one, inset) for one in both])


def _edges_ahead(points: FloatArray, labels: np.ndarray, inset: int) -> FloatArray:
    """Where rows jump away: the next return is so much farther that nothing in sight joins the two.

    Between the last beam on the near side and the next one the edge may be anywhere: it is taken in the middle.
    """
    ranges, n = np.linalg.norm(points, axis=-1), points.shape[1]
    seen, reach = np.isfinite(ranges), max(inset, 1)
    after = np.where(seen, np.arange(n), n)
    after = np.minimum.accumulate(after[:, ::-1], axis=1)[:, ::-1]
    row, column = np.nonzero(seen[:, :-1] & (after[:, 1:] < n))
    inside = column >= reach
    row, column = row[inside], column[inside]
    behind, before = after[row, column + 1], column - reach
    near, far, inner = ranges[row, column], ranges[row, behind], ranges[row, before]
    step = np.abs(near - inner) / reach
    with np.errstate(invalid="ignore"):
        jump = far - near > np.maximum(_BEHIND_M + _BEHIND_SHARE * near, _BEHIND_STEPS * step * (behind - column))
        jump &= np.abs(near - inner) < 0.5 * _BEHIND_M + _BEHIND_SHARE * near
    row, column, behind = row[jump], column[jump], behind[jump]
    a, b = (points[row, k] / ranges[row, k, None] for k in (column, behind))
    one = (labels[row, column] >= 0) & (labels[row, column] == labels[row, behind])
    kept = (np.einsum("ki,ki->k", a, b) > np.cos(_GAP_RAD)) & ~one
    row, column, behind, a, b = row[kept], column[kept], behind[kept], a[kept], b[kept]
    if inset:
        return points[row, column - inset]
    middle = np.where((behind == column + 1)[:, None], a + b, a)
    return middle * (ranges[row, column] / np.linalg.norm(middle, axis=1))[:, None]


def _crowding(rows: FloatArray, width_m: float) -> FloatArray:
    """With how many of its kind an element shares the error of its stretch of surface, itself included, (N,).

    n elements that share an error say as much as n with n times its variance each.
    """
    cell = np.column_stack((np.floor(rows[:, :3] / width_m), rows[:, 7])).astype(np.int64)
    _, inverse, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    return count[inverse.ravel()].astype(np.float64)


def _rows(points: FloatArray, directions: FloatArray, sigma: FloatArray, kind: int) -> FloatArray:
    return np.column_stack((points, directions, sigma, np.full(len(points), float(kind))))
