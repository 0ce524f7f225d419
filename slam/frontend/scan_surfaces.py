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

from typing import NamedTuple

import numpy as np

from slam.frontend._surface_kernels import cube_keys, jumps, moments, moments_about, numbered
from slam.geometry.frames import lift
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray

#: Kinds of elements, as they are stored.
ON_PLANE, ON_NO_PLANE, ON_EDGE = 0, 1, 2
#: Column of stored elements with their width; before it are point, direction, standard deviation along it and kind.
WIDTH = 8
#: Width of an element as a share of its range, rounded down to a power of two metres: it is seen 1 to 2 deg wide.
_SHARE = 0.03
#: On planes, where a few say as much as many, so wide, or as wide as it needs to hold the fewest points.
SHARE_ON_PLANE = 0.06
#: An element is on the plane that it was laid on, to rounding.
ITS_OWN = 1e-6
#: What lies within this of its middle is one thing, m, however many elements see it: whoever walks by close before a
#: camera fills a third of its image.
THING_M = 0.5
#: Fewest points of an element on a plane, and of one whose direction its own points tell.
_LEAST_ON_PLANE, _LEAST = 3, 6


class _Cells(NamedTuple):
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
    def of(cls, points: FloatArray, labels: np.ndarray, share: float, least: int = 1) -> _Cells:
        """Points (N, 3), seen from the origin, with labels (N,) that are kept apart; below nought: left out.

        Of cubes those that hold so many at least.
        """
        keys = cube_keys(points, labels, share)
        number, first, count = numbered(keys)
        mean, scatter = moments(points, number, count)
        order = np.argsort(keys[first])
        kept = order[count[order] >= least]
        return cls(mean[kept], scatter[kept], count[kept], labels[first[kept]])


def surfaces_of(points: FloatArray, labels: np.ndarray, planes: FloatArray, sensor: Sensor) -> FloatArray:
    """Surface elements of a scan in the body frame, rows (point, direction, sigma, kind, width), shape (N, 9).

    Args:
        points: in the sensor's frame, shape (S, B, 3), m; NaN = no return.
        labels: plane of every point, shape (S, B); -1: none.
        planes: rows (normal, d) by label, n.x = d, shape (P, 4).
        sensor: how it errs, and where it sits.
    """
    every = int(np.ceil(np.sqrt(max(np.isfinite(points[..., 0]).sum() / 80_000, 1.0))))  # grids of more are thinned
    thin, thin_labels = points[::every, ::every].reshape(-1, 3), labels[::every, ::every].reshape(-1).astype(np.int64)
    on_plane = np.where(np.isfinite(thin[:, 0]), thin_labels, -1)
    rest = np.where(np.isfinite(thin[:, 0]) & (thin_labels < 0), 0, -1)
    apart = _beams_apart(points)
    wide, own = (
        max(share, 2.0 * every * np.sqrt(least * apart[0] * apart[1]))
        for share, least in ((SHARE_ON_PLANE, _LEAST_ON_PLANE), (_SHARE, _LEAST))
    )
    parts = [
        _on_edges(points, labels, max(apart)),
        _on_planes(_Cells.of(thin, on_plane, wide, _LEAST_ON_PLANE), planes, sensor),
        _on_no_plane(_Cells.of(thin, rest, own, _LEAST), sensor),
    ]
    shares = np.repeat([_SHARE, wide, own], [len(part) for part in parts])
    rows = np.concatenate(parts)
    rows = np.column_stack((rows, shares * np.linalg.norm(rows[:, :3], axis=1)))
    rows[:, 6] = np.hypot(rows[:, 6], sensor.surface_sigma_m * np.sqrt(_crowding(rows, sensor.surface_correlation_m)))
    return moved(rows, sensor.body_T_sensor)


def weights_of(elements: FloatArray) -> FloatArray:
    """How much each of elements (N, 9) says, (N,), in things: the share of one that it covers, by its width, or one.

    Those on a plane together say as much as the root of how many things they cover, as planes do: where one of them
    fits all do, and the floor of a room, which is on most of an image, fits wherever the camera may be.
    """
    things = np.minimum(elements[:, WIDTH] / THING_M, 1.0) ** 2
    on_plane = np.flatnonzero(elements[:, 7] == ON_PLANE)
    if len(on_plane):
        directions = elements[on_plane, 3:6]
        offsets = np.einsum("ki,ki->k", elements[on_plane, :3], directions)
        rows = np.round(np.column_stack((directions, offsets)) / ITS_OWN)
        first = np.append(True, (np.diff(rows, axis=0) != 0.0).any(axis=1))  # most follow one of their plane
        plane = np.unique(rows[first], axis=0, return_inverse=True)[1].ravel()[np.cumsum(first) - 1]
        things[on_plane] /= np.sqrt(np.bincount(plane, things[on_plane]))[plane]
    return things


def moved(elements: FloatArray, pose: FloatArray) -> FloatArray:
    """Elements (N, 9) in the frame that a pose (4, 4) is of theirs in."""
    return np.column_stack((lift(elements[:, :3], pose), elements[:, 3:6] @ pose[:3, :3].T, elements[:, 6:]))


def velocities(points: FloatArray, twist: FloatArray) -> FloatArray:
    """Of points (N, 3) of a body that moves by a twist (6,), GTSAM order (rotation, translation), shape (N, 3)."""
    return twist[3:] + np.cross(twist[:3], points)


def moved_on(elements: FloatArray, times: FloatArray, twist: FloatArray) -> FloatArray:
    """Elements (N, 9 or more) after times (N,) in which their body moves by a twist (6,), small ones."""
    later = elements.copy()
    later[:, :3] += times[:, None] * velocities(elements[:, :3], twist)
    later[:, 3:6] += times[:, None] * np.cross(twist[:3], elements[:, 3:6])
    return later


def _on_planes(cells: _Cells, planes: FloatArray, sensor: Sensor) -> FloatArray:
    normals, d = planes[cells.label, :3], planes[cells.label, 3]
    points = cells.mean - (np.einsum("ki,ki->k", cells.mean, normals) - d)[:, None] * normals
    return _rows(points, normals, _sigma(cells, sensor), ON_PLANE)


def _on_no_plane(cells: _Cells, sensor: Sensor) -> FloatArray:
    values, vectors = np.linalg.eigh(cells.covariance)
    normals = vectors[:, :, 0]
    along = np.einsum("ki,ki->k", normals, cells.mean) / np.maximum(np.linalg.norm(cells.mean, axis=1), 1e-9)
    normals = normals * np.where(along > 0.0, -1.0, 1.0)[:, None]  # toward the sensor
    # points tell a direction that are broad, thin, and not seen edge-on (variances, and a sine)
    flat = (values[:, 1] > 0.1 * values[:, 2]) & (values[:, 0] < 0.1 * values[:, 1]) & (np.abs(along) > 0.15)
    return _rows(cells.mean, normals, _sigma(cells, sensor), ON_NO_PLANE)[flat]


def _sigma(cells: _Cells, sensor: Sensor) -> FloatArray:
    """Standard deviation of the mean of each cell along its direction, (N,), m."""
    variance = sensor.range_variance_at(np.linalg.norm(cells.mean, axis=1))
    return np.sqrt(variance / cells.count)


def _on_edges(points: FloatArray, labels: np.ndarray, width: float) -> FloatArray:
    """Edges before something farther: known across the edge and across the line of sight, to a beam's width, rad."""
    # so far inside, rad, in whole beams, returns are of the near side alone: a camera's pixels blur two sides into one
    inset = round(0.004 / width) if width > 0.0 else 0
    found = _edge_points(points, labels, inset)
    seeds = _Cells.of(found, np.zeros(len(found), dtype=np.int64), 0.5 * _SHARE).mean
    mean, scatter = moments_about(seeds, found, 0.05 * np.linalg.norm(seeds, axis=1), _LEAST)
    values, vectors = np.linalg.eigh(scatter)
    across = np.cross(mean, vectors[:, :, 2])
    ranges, length = np.linalg.norm(mean, axis=1), np.linalg.norm(across, axis=1)
    straight = (values[:, 1] < 0.05 * values[:, 2]) & (length > 0.5 * ranges)
    mean, across = mean[straight], across[straight] / length[straight, None]
    return _rows(mean, across, width * ranges[straight], ON_EDGE)


def _beams_apart(points: FloatArray) -> tuple[float, float]:
    """Angles between neighbouring beams of a grid along its rows and its columns, rad; the other's where it has one."""
    widths = []
    for lines in (points[::16], points[:, ::16].transpose(1, 0, 2)):  # a few lines tell
        with np.errstate(invalid="ignore", divide="ignore"):
            rays = lines / np.sqrt(np.einsum("lbi,lbi->lb", lines, lines))[..., None]
        apart = np.diff(rays, axis=1)
        square = np.einsum("lbi,lbi->lb", apart, apart)
        widths.append(square[np.isfinite(square)])
    known = [float(np.sqrt(np.median(width))) for width in widths if len(width)] or [0.0]
    return known[0], known[-1]


def _edge_points(points: FloatArray, labels: np.ndarray, inset: int) -> FloatArray:
    """Points (N, 3) on the near side of jumps along rows and columns of a grid (S, B, 3), both ways; none twice.

    Between the last beam on the near side and the next one the edge may be anywhere: it is taken in the middle.
    """
    rows, columns = points.shape[:2]
    flat, numbers = np.ascontiguousarray(points).reshape(-1, 3), np.ascontiguousarray(labels, dtype=np.int64).ravel()
    ranges = np.sqrt(np.einsum("ki,ki->k", flat, flat))
    ways = (
        (rows, columns, columns, 1, 0),
        (rows, columns, columns, -1, columns - 1),
        (columns, rows, 1, columns, 0),
        (columns, rows, 1, -columns, (rows - 1) * columns),
    )
    found = np.concatenate([jumps(flat, ranges, numbers, way, inset) for way in ways])
    found = found[np.lexsort(found.T[::-1])]
    return found[np.append(True, (np.diff(found, axis=0) != 0.0).any(axis=1))[: len(found)]]


def _crowding(rows: FloatArray, width_m: float) -> FloatArray:
    """With how many of its kind an element shares the error of its stretch of surface, itself included, (N,).

    n elements that share an error say as much as n with n times its variance each.
    """
    cell = np.column_stack((np.floor(rows[:, :3] / width_m), rows[:, 7])).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    sizes = cell.max(axis=0, initial=0) + 1
    number, _, count = numbered(np.ravel_multi_index(tuple(cell.T), tuple(sizes)))
    return count[number].astype(np.float64)


def _rows(points: FloatArray, directions: FloatArray, sigma: FloatArray, kind: int) -> FloatArray:
    return np.column_stack((points, directions, sigma, np.full(len(points), float(kind))))
