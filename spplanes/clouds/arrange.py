"""Clouds without order become grids: the lines they were recorded in, or the rings of a spinning lidar.

A file keeps the order in which the sensor measured, or it does not. Where the direction of the beam runs along a line
and jumps back to start the next (a nodding or turning 2D laser, a spinning lidar written column by column), the lines
are the rows. Else the cloud is seen as a range image round its sensor, with as many rows as there are rings.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from spplanes._check import FloatArray
from spplanes.clouds.scatter import misses_of

#: Rows and columns, in a whole turn, of the range images that are tried.
_ROWS = (16, 32, 40, 48, 64, 80, 96, 128, 192, 256, 384, 512)
_COLUMNS = (180, 256, 360, 512, 720, 900, 1024, 1440, 1800, 2048, 3600, 4096)


@dataclass(frozen=True)
class Grid:
    """Shape of the range image of a sensor."""

    rows: int
    """Steps of elevation: rings."""
    columns: int
    """Steps of azimuth in a whole turn."""

    def stretch(self, height_rad: float) -> float:
        """How far cells are from squares: the log of their sides' ratio, for rows over so much of elevation."""
        step, turn = max(height_rad, 1e-9) / self.rows, 2.0 * np.pi / self.columns
        return abs(float(np.log(step / turn)))


def arrange(points: FloatArray, grid: Grid | None = None) -> FloatArray:
    """Points (N, 3) round their sensor as a grid (S, B, 3), NaN = no return; a grid stays as it is.

    Where rows are whole turns, they begin at a corner or a gap: a wall ought not to be cut in two by the image's end.

    Args:
        points: shape (N, 3) or (S, B, 3), m, in the sensor's frame.
        grid: shape of the range image; None: lines where the order shows them, else found in the points.
    """
    if points.ndim == 3:
        return np.roll(points, turn_of(points), axis=1)
    used = returns_of(np.asarray(points, dtype=np.float64))
    lines = _lines_of(used) if grid is None else None
    return range_image(used, grid) if lines is None else lines


def are_linked(seen: np.ndarray) -> bool:
    """Whether three in four returns of a grid, mask (S, B), lie beside others, along rows and along columns."""
    ahead = seen[:, :-1], seen[:-1]
    linked = seen[:, :-1] & seen[:, 1:], seen[:-1] & seen[1:]
    return all(both.sum() >= 0.75 * one.sum() for both, one in zip(linked, ahead, strict=True))


def shows_lines(points: FloatArray) -> bool:
    """Whether points (N, 3) come in the lines of a 2D laser that was turned, by their order; a grid (S, B, 3) does not
    say."""
    return points.ndim == 2 and _lines_of(returns_of(points)) is not None


def returns_of(points: FloatArray) -> FloatArray:
    """The points (N, 3) that are finite and not at the sensor, in their order."""
    return points[np.isfinite(points).all(axis=1) & points.any(axis=1)]


def range_image(points: FloatArray, grid: Grid | None = None) -> FloatArray:
    """Points (N, 3) as seen from the sensor, shape (rows, columns, 3): highest row first; of two in a cell the nearer.

    Without a shape the one is taken that spreads the points best: the most cells with a point in them (few points hide
    behind others), as few without (neighbours stay neighbours). For a spinning lidar that is its rings and its steps.
    """
    elevation, azimuth = _angles(points @ _off_pole(points))
    if grid is None:
        grid, row, column = _best_grid(elevation, azimuth)
    else:
        [phase] = _phases_of(azimuth, np.array([grid.columns]))
        row = _rows_of(elevation, elevation.max(), elevation.min(), grid.rows)
        column = _columns_of(azimuth, grid.columns, phase)
    image = nearest_points(points, row, column, grid.rows, grid.columns)
    return np.roll(image, _to_a_corner(image), axis=1)


def turn_of(grid: FloatArray) -> int:
    """By how many columns a grid (S, B, 3) is turned to begin at a corner; 0 unless its rows are whole turns: their
    last beam lies beside the first."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = grid / np.linalg.norm(grid, axis=-1, keepdims=True)
        steps = np.linalg.norm(np.diff(rays, axis=1, append=rays[:, :1]), axis=-1)
    if grid.shape[1] < 8 or not np.isfinite(steps[:, -1]).any() or not np.isfinite(steps[:, :-1]).any():
        return 0
    return _to_a_corner(grid) if np.nanmedian(steps[:, -1]) < 3.0 * np.nanmedian(steps[:, :-1]) else 0


def _to_a_corner(image: FloatArray) -> int:
    """By how many columns the image is turned for its ends to meet where fewest surfaces go on."""
    lag = max(round(image.shape[1] * (1.0 / 360.0)), 1)  # corners are looked for between beams a degree apart
    missed = np.abs(misses_of(image, lag, closed=True))
    seen = missed[np.isfinite(missed)]
    if not len(seen):
        return 0
    return -int(np.count_nonzero(missed < 3.0 * np.median(seen), axis=0).argmin())


def _best_grid(elevation: FloatArray, azimuth: FloatArray) -> tuple[Grid, np.ndarray, np.ndarray]:
    """The shape whose cells times the square of their occupied share are most, and row and column (N,) of the points.

    A thinned cloud fits many shapes about as well, down to rows of four rings each, whose points lie on a zigzag: of
    shapes nearly as good the one with the squarest cells is taken, of equal ones the first. No more cells can be
    occupied than there are, nor than there are points: shapes that could do best are tried first, and those that cannot
    come near the best so far are not tried.
    """
    ends = elevation.max(), elevation.min()
    rows = {count: _rows_of(elevation, *ends, count) for count in _ROWS}
    phases = _phases_of(azimuth, np.array(_COLUMNS))
    columns = {count: _columns_of(azimuth, count, phase) for count, phase in zip(_COLUMNS, phases, strict=True)}
    shapes = [(min(r * c, len(azimuth) ** 2 / (r * c)), -k, r, c) for k, (r, c) in enumerate(product(_ROWS, _COLUMNS))]
    best, tried, as_good = 0.0, [], 0.95
    for bound, order, r, c in sorted(shapes, reverse=True):
        if bound < as_good * best:
            break
        seen = np.zeros(r * c, dtype=bool)
        seen[rows[r] * c + columns[c]] = True
        score = np.count_nonzero(seen) ** 2 / (r * c)
        best = max(best, score)
        tried.append((score, order, Grid(r, c)))
    height = float(ends[0] - ends[1])
    good = [one for one in tried if one[0] >= as_good * best]
    grid = min(good, key=lambda one: (one[2].stretch(height), -one[1]))[2]
    return grid, rows[grid.rows], columns[grid.columns]


def _rows_of(elevation: FloatArray, highest: float, lowest: float, rows: int) -> np.ndarray:
    """Row of every elevation (N,), int32: highest and lowest lie in the middle of the first row and the last."""
    return np.rint((highest - elevation) * ((rows - 1) / max(highest - lowest, 1e-9))).astype(np.int32)


def _phases_of(azimuth: FloatArray, columns: np.ndarray) -> FloatArray:
    """Where in their column beams lie on average, for every number of columns (C,) in a whole turn, (C,), columns. Of
    the sum of e^(i n azimuth), the direction; the powers come from squares of the first."""
    squares = [np.exp(1j * azimuth)]
    for _ in range(int(columns.max()).bit_length() - 1):
        squares.append(squares[-1] ** 2)
    powers = ([square for bit, square in enumerate(squares) if count >> bit & 1] for count in columns)
    return np.angle([np.prod(power, axis=0).sum() for power in powers]) / (2.0 * np.pi)


def _columns_of(azimuth: FloatArray, columns: int, phase: float) -> np.ndarray:
    """Column of every azimuth (N,), rad, of so many in a whole turn, int32: those at the phase lie in the middle."""
    return np.rint(azimuth * (columns / (2.0 * np.pi)) - phase).astype(np.int32) % np.int32(columns)


def nearest_points(points: FloatArray, row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> FloatArray:
    """Image (rows, columns, 3) of points (N, 3): of those in one cell the nearest, of equal ones the last."""
    x, y, z = points.T
    cell, square = row.astype(np.int64) * columns + column, x**2 + y**2 + z**2
    least, image = np.full(rows * columns, np.inf), np.full((rows * columns, 3), np.nan)
    np.minimum.at(least, cell, square)
    nearest = square == least[cell]
    image[cell[nearest]] = points[nearest]
    return image.reshape(rows, columns, 3)


def _off_pole(points: FloatArray) -> FloatArray:
    """Rotation (3, 3), to multiply points (N, 3) with on the right, that keeps the poles of the image out of sight.

    Clouds of cameras have z ahead: there the columns of a range image run together, and most points would share a cell.
    Where z, up or down, lies amid directions that all fill less than a hemisphere (within 78 deg of it, their mean
    within 45 deg), it becomes x; else nothing turns.
    """
    rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    along = rays.mean(axis=0)[2] if len(rays) else 0.0
    ahead = rays[:, 2] * np.sign(along)
    if along == 0.0 or not len(rays) or ahead.min() < 0.2 or abs(along) < 0.7:
        return np.eye(3)
    sign = float(np.sign(along))
    return np.array([[0.0, -sign, 0.0], [0.0, 0.0, -1.0], [sign, 0.0, 0.0]])


def _angles(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Elevation and azimuth, shape (N,) each, rad."""
    return np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])), np.arctan2(points[:, 1], points[:, 0])


def _lines_of(points: FloatArray) -> FloatArray | None:
    """The lines that the order of the points shows, shape (S, B, 3); None where it shows none. A line starts where the
    beam turns by 20 deg and by ten of the usual steps. Lines are believed when there are eight at least, of eight
    points (median), and none is much longer."""
    if len(points) < 64:
        return None
    x, y, z = points.T
    length = np.sqrt(x * x + y * y + z * z)
    along = x[1:] * x[:-1] + y[1:] * y[:-1] + z[1:] * z[:-1]
    cosines = np.clip(along / (length[:-1] * length[1:]), -1.0, 1.0)  # of the angle from every point to the next
    limit = max(0.35, 10.0 * float(np.arccos(np.median(cosines))))
    if limit >= np.pi:
        return None
    starts = np.concatenate(([0], np.flatnonzero(cosines < np.cos(limit)) + 1, [len(points)]))
    lengths = np.diff(starts)
    if len(lengths) < 8 or np.median(lengths) < 8 or lengths.max() > 1.6 * np.median(lengths):
        return None
    lines = [points[a:b] for a, b in pairwise(starts)]
    lines = [line for k, line in enumerate(lines) if k == 0 or not np.array_equal(line, lines[k - 1])]
    return _stacked(lines)


def _stacked(lines: list[FloatArray]) -> FloatArray | None:
    """Lines as rows: a beam's column is its angle along the lines; None where the angles do not run one way."""
    angles = [_angles(line) for line in lines]
    spans = np.median([[np.ptp(elevation), np.ptp(azimuth)] for elevation, azimuth in angles], axis=0)
    along = [pair[int(spans[1] > spans[0])] for pair in angles]
    steps = np.concatenate([np.diff(angle) for angle in along])
    step = float(np.median(steps))
    if step == 0.0 or np.mean(steps * step > 0.0) < 0.9:
        return None
    first = min((angle[0] for angle in along), key=lambda value: value * np.sign(step))
    columns = [np.rint((angle - first) / step).astype(np.int64) for angle in along]
    width = max(int(column.max()) for column in columns) + 1
    if min(int(column.min()) for column in columns) < 0 or width > 4096:
        return None
    grid = np.full((len(lines), width, 3), np.nan)
    for row, (column, line) in enumerate(zip(columns, lines, strict=True)):
        grid[row, column] = line
    return grid
