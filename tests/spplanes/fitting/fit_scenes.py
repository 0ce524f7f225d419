"""The scenes on which plane fits are judged: true points on a known plane, and how their noise is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from spplanes.spmodel import inverse_transform
from tests.statistics import nees


@dataclass(frozen=True)
class Scene:
    """A patch of a plane, seen from the origin of the sensor."""

    true_points: np.ndarray
    """Shape (N, 3), on the plane."""
    covariances: np.ndarray
    """Shape (N, 3, 3)."""
    frame: np.ndarray
    """A frame of the true plane, (4, 4)."""
    sensor: np.ndarray
    """Where it was seen from, (3,)."""
    scan_index: np.ndarray | None = None
    """Scan of each point, (N,)."""
    pose_covariances: np.ndarray | None = None
    """Of the scans, (S, 6, 6), or jointly, (6 S, 6 S)."""
    model: Callable[[np.ndarray], np.ndarray] | None = None
    """Covariances (N, 3, 3) that the sensor model gives for points (N, 3)."""

    @property
    def shared(self) -> dict:
        """Arguments of the shared-pose term."""
        if self.scan_index is None:
            return {}
        return {"scan_index": self.scan_index, "pose_covariances": self.pose_covariances}

    @cached_property
    def roots(self) -> np.ndarray:
        """Square roots of the covariances, (N, 3, 3)."""
        return psd_roots(self.covariances)

    @cached_property
    def pose_roots(self) -> np.ndarray:
        """Square roots of the pose covariances, of their shape."""
        return psd_roots(self.pose_covariances)

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Noisy points (N, 3)."""
        points = self.true_points + np.einsum("nij,nj->ni", self.roots, rng.normal(size=self.true_points.shape))
        if self.scan_index is None:
            return points
        xi = self.pose_roots @ rng.normal(size=(*self.pose_roots.shape[:-1], 1))
        return moved(points, xi.reshape(-1, 6)[self.scan_index])

    def linear(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (N, 3) of the points' distances by (z, theta, psi) in `frame`, and those' covariance (N, N)."""
        n, local = self.frame[:3, 2], (self.true_points - self.frame[:3, 3]) @ self.frame[:3, :3]
        h = np.column_stack([np.ones(len(local)), -local[:, 0], local[:, 1]])
        total = np.diag(np.einsum("i,nij,j->n", n, self.covariances, n))
        if self.scan_index is not None:
            joint = self.pose_covariances if self.pose_covariances.ndim == 2 else block_diag(*self.pose_covariances)
            rotations = [np.cross(axis, self.true_points) @ n for axis in np.eye(3)[::-1]]
            by_poses = np.zeros((len(local), len(joint) // 6, 6))
            by_poses[np.arange(len(local)), self.scan_index, :3] = n
            by_poses[np.arange(len(local)), self.scan_index, 3:] = np.column_stack(rotations)
            by_poses = by_poses.reshape(len(local), -1)
            total += by_poses @ joint @ by_poses.T
        return h, total

    def crb(self) -> np.ndarray:
        """Cramer-Rao bound of (z, theta, psi) in `frame`, (3, 3): sensor noise and, if any, shared pose errors."""
        h, total = self.linear()
        return np.linalg.inv(h.T @ np.linalg.solve(total, h))


def error_of(frame: np.ndarray, true_frame: np.ndarray) -> np.ndarray:
    """(z, theta, psi) that leads from an estimated frame to the true plane, in the estimated frame, or back."""
    n, centre = (inverse_transform(frame) @ true_frame)[:3, 2:].T
    return np.array([n @ centre / n[2], np.arctan2(n[0], n[2]), -np.arctan2(n[1], n[2])])


def psd_roots(covariances: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariances)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def moved(points: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Points under world-side perturbations (x, y, z, phi, theta, psi), one each, to first order."""
    z, y, x = np.eye(3)[::-1]
    turned = xi[:, 3:4] * np.cross(z, points) + xi[:, 4:5] * np.cross(y, points) + xi[:, 5:6] * np.cross(x, points)
    return points + xi[:, :3] + turned


def plane_frame(distance: float, incidence_deg: float) -> np.ndarray:
    """A wall whose centre is ``distance`` ahead on a skew line of sight, met at ``incidence_deg`` from its normal."""
    sight = np.array([0.8, 0.5, 0.3]) / np.linalg.norm([0.8, 0.5, 0.3])
    side = np.cross(sight, [0.2, -0.3, 1.0])
    side /= np.linalg.norm(side)
    angle = np.deg2rad(incidence_deg)
    n = -np.cos(angle) * sight + np.sin(angle) * side
    x = np.cross(n, sight) if incidence_deg > 1.0 else np.cross(n, side)
    frame = np.eye(4)
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1] = np.cross(n, frame[:3, 0])
    frame[:3, 2], frame[:3, 3] = n, distance * sight
    return frame


def patch(frame: np.ndarray, n: int, width: float, height: float, rng: np.random.Generator) -> np.ndarray:
    """Points spread evenly at random over a patch about the frame's origin."""
    local = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * (width, height), np.zeros(n)])
    return local @ frame[:3, :3].T + frame[:3, 3]


def laser_covariances(points: np.ndarray, sigma_range, sigma_angle: float) -> np.ndarray:
    """Noise along the beam, and across it in proportion to the range, seen from the origin."""
    ranges = np.linalg.norm(points, axis=1)
    beams = points / ranges[:, None]
    along = np.einsum("ni,nj->nij", beams, beams)
    variances = np.broadcast_to(sigma_range, ranges.shape) ** 2, (sigma_angle * ranges) ** 2
    return variances[0][:, None, None] * along + variances[1][:, None, None] * (np.eye(3) - along)


def _wall(n, distance, incidence, width, height, noise) -> Scene:
    frame, rng = plane_frame(distance, incidence), np.random.default_rng(5)
    points = patch(frame, n, width, height, rng)
    return Scene(points, noise(points), frame, np.zeros(3), model=noise)


_laser = partial(laser_covariances, sigma_range=0.015, sigma_angle=0.002)


def _growing(points):
    return laser_covariances(points, 0.005 + 0.004 * np.linalg.norm(points, axis=1), 0.002)


def _offset() -> Scene:
    wall, offset = _wall(300, 3.0, 30.0, 3.0, 2.0, _laser), np.array([1e6, -1e6, 1e6])
    frame = wall.frame.copy()
    frame[:3, 3] += offset
    return Scene(wall.true_points + offset, wall.covariances, frame, offset)


def _many_scans() -> Scene:
    """20 vertical slices of a wall, each seen from a robot whose pose is uncertain."""
    frame = plane_frame(3.0, 20.0)
    rng = np.random.default_rng(5)
    local = np.zeros((20, 15, 3))
    local[..., 0] = np.linspace(-1.5, 1.5, 20)[:, None]
    local[..., 1] = np.linspace(-1.0, 1.0, 15) + rng.uniform(-0.02, 0.02, (20, 15))
    points = local.reshape(-1, 3) @ frame[:3, :3].T + frame[:3, 3]
    root = rng.normal(size=(20, 6, 6)) * np.array([0.01, 0.01, 0.005, 0.004, 0.002, 0.002])[:, None] * 0.5
    poses = root @ root.transpose(0, 2, 1)
    return Scene(points, _laser(points), frame, np.zeros(3), np.repeat(np.arange(20), 15), poses)


def scenes() -> dict[str, Scene]:
    """The nine scenes by name."""
    return {
        "frontal wall": _wall(300, 3.0, 0.0, 3.0, 2.0, _laser),
        "wall at 75 deg": _wall(300, 4.0, 75.0, 3.0, 2.0, _laser),
        "30 m away": _wall(300, 30.0, 20.0, 6.0, 3.0, _laser),
        "strip 10 m x 0.1 m": _wall(300, 8.0, 15.0, 10.0, 0.1, lambda p: laser_covariances(p, 0.004, 0.0003)),
        "12 points": _wall(12, 3.0, 30.0, 3.0, 2.0, _laser),
        "noise growing with range": _wall(300, 5.0, 60.0, 6.0, 3.0, _growing),
        "noise along the beam": _wall(300, 4.0, 60.0, 3.0, 2.0, lambda p: laser_covariances(p, 0.015, 0.0)),
        "offset by 1e6 m": _offset(),
        "20 scans, shared poses": _many_scans(),
    }


def run(scene: Scene, fit, runs: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """NEES (R,), errors in the frame of the truth (R, 3), and the estimated planes' covariances (R, 3, 3)."""
    rng = np.random.default_rng(seed)
    errors, local, covariances = np.empty((runs, 3)), np.empty((runs, 3)), np.empty((runs, 3, 3))
    for r in range(runs):
        plane = fit(scene.sample(rng), scene)
        errors[r], covariances[r] = error_of(plane.frame, scene.frame), plane.covariance
        local[r] = error_of(scene.frame, plane.frame)
    return nees(errors, covariances), local, covariances


class Linear(NamedTuple):
    """Normalised squared errors (R,), 3 degrees of freedom each; errors of (z, theta, psi) about the truth, (R, 3)."""

    chi2: np.ndarray
    local: np.ndarray


def linear_run(scene: Scene, runs: int, seed: int, weights: np.ndarray | None = None) -> Linear:
    """The linear estimate on the same points as `run` with a fit that draws nothing: exactly as sure as it says, by the
    best weights, at the truth, or by those that are given, (N,).

    A fit errs nearly as this does, so the difference of two means hardly scatters: one with 200 runs tells an error of
    the covariance from none as well as the mean of a fit alone with 10,000 and more.
    """
    rng, (h, total) = np.random.default_rng(seed), scene.linear()
    distances = np.stack([(scene.sample(rng) - scene.true_points) @ scene.frame[:3, 2] for _ in range(runs)])
    weighted = np.linalg.solve(total, h).T if weights is None else h.T * weights
    by = np.linalg.solve(weighted @ h, weighted)
    local = distances @ by.T
    return Linear(nees(local, np.broadcast_to(by @ total @ by.T, (runs, 3, 3))), local)


def loss(local: np.ndarray, scene: Scene) -> float:
    """Root mean square error over the Cramer-Rao bound, all three components in the bound's own metric."""
    return float(np.sqrt(nees(local, np.broadcast_to(scene.crb(), (len(local), 3, 3))).mean() / 3.0))
