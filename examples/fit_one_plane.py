"""One plane through uncertain points, and what its covariance is worth.

A wall of 3 x 2.4 m, seen obliquely by a laser whose range noise grows with the range. The fit is printed beside the
truth; then 400 fits of the same wall under fresh noise say whether the covariances are honest: the mean squared
Mahalanobis distance (NEES) of 3 parameters should be 3. At the end the same is done for a push-broom laser, whose scans
each carry an error of their own pose: told about it the fit stays honest, not told it is far too sure of itself.
"""

import numpy as np

from spplanes import Plane, fit_plane
from spplanes.noise import SensorModel

SENSOR = np.array([0.0, 0.0, 1.2])
NORMAL, D = np.array([-0.8, -0.6, 0.0]), -2.5
LASER = SensorModel(range_sigma_m=0.01, range_sigma_share=0.004)
POSE_SIGMAS = np.array([0.004, 0.004, 0.0, 0.001, 0.0, 0.0])  # x, y, z, phi, theta, psi


def wall_points(rng: np.random.Generator, count: int) -> np.ndarray:
    """True points (N, 3) on the wall, between 0 and 2.4 m of height."""
    along, up = rng.uniform(-1.0, 2.0, count), rng.uniform(0.0, 2.4, count)
    return D * NORMAL + along[:, None] * np.array([0.6, -0.8, 0.0]) + up[:, None] * np.array([0.0, 0.0, 1.0])


def measured(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points with an error along their beam, and their covariances (N, 3, 3)."""
    rays = points - SENSOR
    ranges = np.linalg.norm(rays, axis=1)
    noise = rng.normal(0.0, np.sqrt(LASER.range_variance(ranges)))
    seen = points + rays * (noise / ranges)[:, None]
    return seen, LASER.covariances(seen, SENSOR)


def moved_scans(points: np.ndarray, scan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) after the pose error of their scan (N,): a shift and a turn about the vertical."""
    errors = rng.normal(size=(scan.max() + 1, 6)) * POSE_SIGMAS
    turned = np.stack((-points[:, 1], points[:, 0], np.zeros(len(points))), axis=1)
    return points + errors[scan, :3] + errors[scan, 3:4] * turned


def main() -> None:
    """Fit one wall, then many."""
    rng = np.random.default_rng(0)
    truth = Plane.from_hesse(NORMAL, D, np.zeros((3, 3)))
    points, covariances = measured(wall_points(rng, 300), rng)
    plane = fit_plane(points, covariances, viewpoint=SENSOR)
    sigma_z, sigma_theta, sigma_psi = np.sqrt(np.diag(plane.covariance))
    angle = np.degrees(np.arccos(np.clip(plane.normal @ NORMAL, -1.0, 1.0)))
    print(f"normal {plane.normal.round(4)}, {angle:.3f} deg from the truth; d = {plane.d:.4f} m (true {D})")
    print(f"at its centre: {1e3 * truth.distance(plane.centre):+.2f} mm off, predicted sigma {1e3 * sigma_z:.2f} mm")
    print(f"predicted tilt sigmas: {np.degrees(sigma_theta):.3f} and {np.degrees(sigma_psi):.3f} deg")
    print(f"chi2 of the fit: {plane.chi2:.0f} for {plane.n_points - 3} degrees of freedom")

    fits = [fit_plane(*measured(wall_points(rng, 300), rng), viewpoint=SENSOR) for _ in range(400)]
    values = [fit.mahalanobis(truth) for fit in fits]
    print(f"mean NEES of 400 fits: {np.mean(values):.2f} (3 is right, +- {np.sqrt(6 / 400):.2f})")

    told, untold = [], []
    scan = np.repeat(np.arange(10), 30)
    for _ in range(200):
        points, covariances = measured(wall_points(rng, 300), rng)
        points = moved_scans(points, scan, rng)
        shared = np.tile(np.diag(POSE_SIGMAS**2), (10, 1, 1))
        fit = fit_plane(points, covariances, viewpoint=SENSOR, scan_index=scan, pose_covariances=shared)
        told.append(fit.mahalanobis(truth))
        untold.append(fit_plane(points, covariances, viewpoint=SENSOR).mahalanobis(truth))
    print(f"10 scans with pose errors, 200 fits: mean NEES {np.mean(told):.2f} told of them (3 is right, ", end="")
    print(f"+- {np.sqrt(6 / 200):.2f}), {np.mean(untold):.2f} not told")


if __name__ == "__main__":
    main()
