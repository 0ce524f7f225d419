"""Scans of rooms full of polyhedra with true labels: like those of the SynPEB benchmark, but as many as one likes."""

import numpy as np
from scipy.spatial.transform import Rotation

from spplanes._check import FloatArray

#: Range noise of the benchmark's scanner, and the angular noise that its residuals on grazing planes show.
RANGE_SIGMA_M, ANGLE_SIGMA_RAD = 0.001, 3e-4
#: Bodies in a room, and how wide and high the scanner sees, rad.
BODIES, WIDE_RAD, HIGH_RAD = 9, 1.0, 0.9


def polyhedra_scan(seed: int, size: int = 500) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Points (size, size, 3), their covariances (size, size, 3, 3) and true planes (size, size), 1..K, 0 = none.

    A room 6 m deep; in it boxes, wedges, truncated pyramids and stairs, turned and tilted at random.
    """
    rng = np.random.default_rng(seed)
    elevation, azimuth = np.meshgrid(
        np.linspace(0.5, -0.5, size) * HIGH_RAD + 0.02, np.linspace(0.5, -0.5, size) * WIDE_RAD, indexing="ij"
    )
    rays, room = _directions(azimuth, elevation), _room(rng)
    ranges, labels = _inside(rays, *room)
    planes = list(np.column_stack(room))
    for body in [_body(rng) for _ in range(BODIES)]:
        first = len(planes)
        for normals, offsets, shift in body:
            distance = offsets + normals @ shift
            near, face = _outside(rays, normals, distance)
            number = [_number_of(plane, planes, first) for plane in np.column_stack((normals, distance))]
            nearer = near < ranges
            ranges, labels = np.where(nearer, near, ranges), np.where(nearer, np.array(number)[face], labels)
    noise = rng.standard_normal((3, *ranges.shape))
    read = _directions(azimuth + ANGLE_SIGMA_RAD * noise[1], elevation + ANGLE_SIGMA_RAD * noise[2])
    points = (ranges + RANGE_SIGMA_M * noise[0])[..., None] * read
    along = rays[..., :, None] * rays[..., None, :]
    across = (ANGLE_SIGMA_RAD * ranges[..., None, None]) ** 2
    covariances = RANGE_SIGMA_M**2 * along + across * (np.eye(3) - along)
    _, numbers = np.unique(labels, return_inverse=True)
    return points, covariances, numbers.reshape(labels.shape) + 1


def _number_of(plane: FloatArray, planes: list[FloatArray], first: int) -> int:
    """Number of a face's plane, in the list from now on; the sides of steps share theirs."""
    for k in range(first, len(planes)):
        if np.allclose(planes[k], plane, atol=1e-9):
            return k
    planes.append(plane)
    return len(planes) - 1


def _directions(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    flat = np.cos(elevation)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)


def _rotation(rng: np.random.Generator, tilted: bool) -> FloatArray:
    turn = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi))
    if tilted:
        axis, angle = rng.standard_normal(3), rng.uniform(0.1, 0.8)
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * turn
    return turn.as_matrix()


def _room(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Faces (normals outward) and offsets of the room round the scanner."""
    turn = _rotation(rng, False)
    normals = np.vstack((np.eye(3), -np.eye(3))) @ turn.T
    return normals, np.array([5.0, 4.0, 1.5, 5.0, 4.5, 1.3]) + rng.uniform(-0.3, 0.3, 6)


def _body(rng: np.random.Generator) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """One body: a box, a wedge, a truncated pyramid, or three steps; (normals, offsets, centre) of each convex part."""
    place = np.array([rng.uniform(1.8, 4.2), 0.0, 0.0])
    place[1:] = place[0] * rng.uniform(-0.42, 0.42, 2)
    half, kind = rng.uniform(0.12, 0.45, 3), rng.integers(4)
    turn = _rotation(rng, kind != 3)
    normals, offsets = np.vstack((np.eye(3), -np.eye(3))), np.concatenate((half, half))
    if kind == 1:  # a wedge: one slanted face across the box
        slant = np.array([1.0, 0.0, rng.uniform(0.4, 2.0)])
        normals, offsets = np.vstack((normals, slant / np.linalg.norm(slant))), np.append(offsets, 0.0)
    if kind == 2:  # a truncated pyramid: the sides lean in
        lean = rng.uniform(0.15, 0.6)
        normals[[0, 1, 3, 4], 2] += lean
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if kind == 3:  # steps
        height, depth = rng.uniform(0.05, 0.15), rng.uniform(0.1, 0.25)
        steps = [(np.array([0.0, 0.0, -k * height]), half + np.array([k * depth, 0.0, 0.0])) for k in range(3)]
        return [(normals @ turn.T, np.concatenate((s, s)), place + turn @ c) for c, s in steps]
    return [(normals @ turn.T, offsets, place)]


def _inside(rays: FloatArray, normals: FloatArray, offsets: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Range and face of the room that every ray meets first."""
    towards = rays @ normals.T
    reach = np.where(towards > 1e-9, offsets / np.maximum(towards, 1e-9), np.inf)
    return reach.min(axis=-1), reach.argmin(axis=-1)


def _outside(rays: FloatArray, normals: FloatArray, distance: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Range and face of a convex body that every ray meets first, infinite where it misses it."""
    towards = rays @ normals.T
    with np.errstate(divide="ignore"):
        reach = distance / towards
    entry, leave = np.where(towards < 0.0, reach, -np.inf), np.where(towards > 0.0, reach, np.inf)
    hit = (entry.max(axis=-1) < leave.min(axis=-1)) & (entry.max(axis=-1) > 0.0)
    return np.where(hit, entry.max(axis=-1), np.inf), entry.argmax(axis=-1)
