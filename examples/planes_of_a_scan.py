"""The planes of one organised 3D scan: a room with a box in it, as a spinning laser sees it.

The scan is a grid of beams, (rows, columns, 3), NaN where nothing came back. `segment_scans` needs no thresholds in
metres: the covariance of every point says what is noise. A grid ends at its first and last column, so the wall across
that seam comes out as two planes; a chi2 test says that they are one, and `Plane.merge` makes them one. Each plane is
printed with its distance from the true plane and with the standard deviation it claims.
"""

import numpy as np

from spplanes import Plane, segment_scans
from spplanes.noise import SensorModel

LASER = SensorModel(range_sigma_m=0.012)
ROOM = np.array([[-2.0, -1.5, 0.0], [4.0, 2.5, 2.6]])
BOX = np.array([[1.2, -0.2, 0.0], [2.2, 0.9, 0.8]])
SENSOR = np.array([0.0, 0.0, 1.3])
SIDES = ("back", "right", "floor", "front", "left", "ceiling")


def beams() -> np.ndarray:
    """Unit directions of 64 rings of 360 beams, -50 to 60 deg of elevation, shape (64, 360, 3)."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(360.0) - 180.0), np.radians(np.linspace(60.0, -50.0, 64)))
    level = np.cos(elevation)
    return np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=2)


def ranges_to(corners: np.ndarray, directions: np.ndarray, *, inside: bool) -> np.ndarray:
    """Ranges to the walls of an axis-parallel box, seen from inside or outside; infinite where it is missed."""
    with np.errstate(divide="ignore"):
        crossings = np.sort((corners - SENSOR)[:, None, None, :] / directions, axis=0)
    enter, leave = crossings[0].max(axis=2), crossings[1].min(axis=2)
    if inside:
        return leave
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)


def simulate(rng: np.random.Generator) -> np.ndarray:
    """Points (64, 360, 3) of one scan; two percent of the beams are lost, and all those into an open door."""
    directions = beams()
    ranges = np.minimum(ranges_to(ROOM, directions, inside=True), ranges_to(BOX, directions, inside=False))
    hits = SENSOR + ranges[..., None] * directions
    door = (hits[..., 0] < ROOM[0, 0] + 1e-6) & (np.abs(hits[..., 1] - 0.5) < 0.45) & (hits[..., 2] < 2.0)
    ranges += rng.normal(0.0, LASER.range_sigma_m, ranges.shape)
    ranges[door | (rng.random(ranges.shape) < 0.02)] = np.nan
    return SENSOR + ranges[..., None] * directions


def name_of(normal: np.ndarray, d: float) -> tuple[str, float]:
    """The true surface with this normal nearest in d, and its d."""
    axis = int(np.argmax(np.abs(normal)))
    sign = float(np.sign(normal[axis]))
    room, box = sign * ROOM[int(sign < 0), axis], sign * BOX[int(sign > 0), axis]
    side = SIDES[axis + 3 * int(sign < 0)]
    return (side, room) if abs(d - room) < abs(d - box) else (f"box, {'+' if sign > 0 else '-'}{'xyz'[axis]}", box)


def merged(planes: list[Plane]) -> list[Plane]:
    """The planes, those joined that are one by chi2 (3 degrees of freedom, 99.9 %)."""
    result: list[Plane] = []
    for plane in planes:
        twin = next((k for k, other in enumerate(result) if plane.mahalanobis(other) < 16.27), None)
        if twin is None:
            result.append(plane)
        else:
            result[twin] = result[twin].merge(plane)
    return result


def main() -> None:
    """Segment one scan and print its planes."""
    points = simulate(np.random.default_rng(0))
    covariances = LASER.covariances(points, SENSOR)
    labels, parts = segment_scans(points, covariances, viewpoints=SENSOR)
    planes = merged(parts)
    returns = np.isfinite(points).all(axis=2)
    print(f"{len(parts)} planes hold {100 * (labels >= 0).sum() / returns.sum():.1f} % of {returns.sum()} points")
    print(f"{len(planes)} planes after joining those that are one")
    print("surface   points  error at centre  claimed sigma  tilt error  claimed sigma")
    for plane in sorted(planes, key=lambda plane: -plane.n_points):
        name, d = name_of(plane.normal, plane.d)
        axis = int(np.argmax(np.abs(plane.normal)))
        truth = np.sign(plane.normal[axis]) * np.eye(3)[axis]
        sigma_z, sigma_tilt = np.sqrt(plane.covariance[0, 0]), np.sqrt(np.trace(plane.covariance[1:, 1:]))
        tilt = np.arcsin(np.linalg.norm(np.cross(plane.normal, truth)))
        print(
            f"{name:9} {plane.n_points:6}  {1e3 * (truth @ plane.centre - d):+12.2f} mm  {1e3 * sigma_z:10.2f} mm"
            f"  {np.degrees(tilt):6.3f} deg  {np.degrees(sigma_tilt):9.3f} deg"
        )


if __name__ == "__main__":
    main()
