"""Bends and steps: a plane that is two, at so blunt an angle or so near each other that no single point tells it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spplanes._check import FloatArray

#: Cells along either side of a plane, by whose means bends are told, and fewest on either side of one.
_CELLS, _FEWEST = 12, 2


class Bend(NamedTuple):
    """Where residuals of a plane bend or step most surely."""

    chi2: float
    """What it explains beyond offset and tilt (1 dof), the largest of some hundred."""
    height_m: float
    """How far from the plane it leads at most, m."""
    sigma_m: float
    """Standard deviation of that by the noise of the points, m."""
    direction: FloatArray
    """Unit vector on the plane, square to it, shape (2,)."""
    between_m: tuple[float, float]
    """Between which places along that it is, m."""

    def is_sure(self, uneven_m: float, least_m: float, limit: float) -> bool:
        """Whether it is no plane's, uneven by such a standard deviation and by `least_m` in any case, m."""
        noise = self.sigma_m**2
        return self.height_m > least_m and self.chi2 * noise > limit * (noise + uneven_m**2)

    def sides(self, places: FloatArray) -> tuple[np.ndarray, np.ndarray]:
        """Which places (N, 2) are on this side of it and which are beyond it, shape (N,) both."""
        along = places @ self.direction
        return along < self.between_m[0], along > self.between_m[1]


def surest_bend(places: FloatArray, residuals: FloatArray, weights: FloatArray) -> Bend | None:
    """The surest bend of a plane: residuals that go as |u - q|, or step at u = q, u along some direction on the plane.

    A region that runs a little way round a blunt corner, or onto the next wall a few millimetres before it, tilts
    between both, and what is left of its residuals hides in the noise of every point and of every patch; not in that of
    all points beyond. None where there are too few cells with points to tell one. Places (N, 2) are on the plane, m;
    their noise must not go with that of the residuals (N,) along its normal, m, with weights (N,), 1 / m^2.
    """
    cells = _cells_of(places, residuals, weights)
    if len(cells) < 2 * _FEWEST:
        return None
    step, ends = np.pi / 8, (_FEWEST / _CELLS, 1.0 - _FEWEST / _CELLS)
    found, angle = _surest(cells, step * np.arange(0.0, 8), np.linspace(*ends, _CELLS - 2 * _FEWEST + 1))
    for _ in range(4 if found.chi2 > 8.0 else 0):  # about a direction that is worth it they are halved
        step /= 2.0
        found, angle = _surest(cells, angle + step * np.arange(-1.0, 2.0), np.linspace(*ends, 33))
    return found


def _surest(cells: FloatArray, angles: FloatArray, shares: FloatArray) -> tuple[Bend, float]:
    """The surest of the bends and steps square to some angles (A,), after some shares (Q,) of the way along each, and
    its angle; it is anywhere that is hardly less sure, within three standard deviations."""
    weight, place, mean = cells[:, 0], cells[:, 1:3], cells[:, 3]
    directions = np.stack((np.cos(angles), np.sin(angles)))
    along = place @ directions
    low, high = along.min(axis=0), along.max(axis=0)
    places = low + shares[:, None] * (high - low)
    off = along[:, None, :] - places
    shape = np.stack((np.abs(off), np.where(off > 0.0, high - low, 0.0)), axis=1).reshape(len(cells), -1)
    trend, root = np.column_stack((np.ones(len(cells)), place)), np.sqrt(weight)[:, None]
    basis, _ = np.linalg.qr(root * trend)
    shape, left = (root * one - basis @ (basis.T @ (root * one)) for one in (shape, mean[:, None]))
    least = 1e-12 * weight.sum() * np.tile(high - low, 2 * len(shares)) ** 2
    information, pull = np.maximum((shape**2).sum(axis=0), least), (shape * left).sum(axis=0)
    # a step must be surer than a bend: ten times as many tell apart, and 2 log 10 is 4.6
    chi2 = pull**2 / information - np.repeat((0.0, 4.6), places.size)
    best = int(np.argmax(chi2))
    column, most = best % len(angles), float(np.abs(shape[:, best] / root[:, 0]).max())
    by_place = chi2.reshape(2, *places.shape)[:, :, column].max(axis=0)
    among = places[by_place >= chi2[best] - 9.0, column]
    height, sigma = most * abs(float(pull[best])) / float(information[best]), most / float(np.sqrt(information[best]))
    between = float(among.min()), float(among.max())
    return Bend(float(chi2[best]), height, sigma, directions[:, column], between), float(angles[column])


def _cells_of(places: FloatArray, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Of the cells with points: weight, mean place and mean residual, shape (C, 4)."""
    low = places.min(axis=0)
    side = np.maximum((places.max(axis=0) - low) / _CELLS, 1e-9)
    column, row = np.minimum(((places - low) / side).astype(np.int64), _CELLS - 1).T
    cell = row * _CELLS + column
    total = np.bincount(cell, weights, _CELLS**2)
    there = total > 0.0
    sums = [np.bincount(cell, weights * one, _CELLS**2)[there] for one in (*places.T, residuals)]
    return np.column_stack((total[there], *(one / total[there] for one in sums))).astype(np.float64)
