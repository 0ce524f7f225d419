"""What cameras and scanners see of planes and boxes, with truth."""

import numpy as np


def rays(rows=48, cols=64, fov=1.0):
    """Unit rays of a small camera looking along +x, shape (rows, cols, 3)."""
    v, u = np.meshgrid(np.linspace(-0.75, 0.75, rows) * fov, np.linspace(-1, 1, cols) * fov, indexing="ij")
    directions = np.stack((np.ones_like(u), -u, -v), axis=-1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def spun(elevations, azimuths):
    """Unit rays of a spinning scanner, x ahead at azimuth nought, shape (elevations, azimuths, 3)."""
    elevation, azimuth = np.meshgrid(elevations, azimuths, indexing="ij")
    level = np.cos(elevation)
    return np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=-1)


def to_walls(directions, low, high):
    """Ranges from inside a box whose corners are at `low` and `high` from the eye, shape (...)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(directions > 0.0, high, low) / directions
    return ranges.min(axis=-1, where=directions != 0.0, initial=np.inf)


def cast(directions, planes):
    """Nearest hit of every ray with planes (normal, d, inside(points) -> bool): points and index, -1 = none."""
    best, label = np.full(directions.shape[:2], np.inf), np.full(directions.shape[:2], -1)
    for k, (normal, d, inside) in enumerate(planes):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = d / (directions @ np.asarray(normal, dtype=float))
            hits = inside(directions * t[..., None]) & (t > 0) & (t < best)
        best[hits], label[hits] = t[hits], k
    points = directions * np.where(np.isfinite(best), best, np.nan)[..., None]
    return points, label


def anywhere(points):
    return np.ones(points.shape[:2], dtype=bool)


def noisy(points, sigma, seed):
    """Points with noise along their rays, seen from the origin."""
    ranges = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * (1.0 + sigma * np.random.default_rng(seed).standard_normal(ranges.shape) / ranges)


def beam_covariances(points, sigma, across=1e-4):
    """sigma along the ray, `across` across it, shape (..., 3, 3)."""
    u = points / np.linalg.norm(points, axis=-1, keepdims=True)
    along = u[..., :, None] * u[..., None, :]
    return sigma**2 * along + across**2 * (np.eye(3) - along)


def box():
    """Inside a room: front wall, two side walls, floor and ceiling."""
    return [
        ((1, 0, 0), 4.0, anywhere),
        ((0, 1, 0), 2.0, anywhere),
        ((0, -1, 0), 2.0, anywhere),
        ((0, 0, -1), 1.2, anywhere),
        ((0, 0, 1), 1.4, anywhere),
    ]
