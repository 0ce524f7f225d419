"""Points of one scan share the error of its pose: the plane fit that knows.

The error of scan s is a world-side perturbation xi_s = (x, y, z, phi, theta, psi) with covariance S_s, independent
between scans: p' = p + t + phi (z x q) + theta (y x q) + psi (x x q), q = p - o_s. A point is then off the plane by its
own noise and by g.xi_s, g = n^T dp/dxi. Maximum likelihood estimates plane and xi together; each scan's xi is
eliminated, so the cost is one 6x6 solve a scan. Where the errors of scans hang together, as those of poses from
odometry do, their joint covariance takes the place of the S_s, and all xi are eliminated in one solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_covariance, as_covariance_stack, as_shape
from spplanes._jit import njit
from spplanes._rows import OK, OPEN_POSES, column, cross, dot, minus
from spplanes.fitting import _kernels as kernels
from spplanes.fitting._pose_error import lever
from spplanes.fitting._sums import FLOOR, N_SUMS, accumulate

#: Points and their covariances, as in the kernels.
Cloud = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class SharedPose:
    """Which point belongs to which scan, and how uncertain the scans' poses are."""

    scan: np.ndarray
    """Scan of each point, shape (N,), int64, in 0..S-1."""
    roots: FloatArray
    """Square roots L of the pose covariances, S = L L^T: (S, 6, 6), or of their joint covariance (1, 6 S, M)."""
    origins: FloatArray
    """Points about which the rotations act, shape (S, 3), m."""

    @classmethod
    def checked(
        cls,
        points: FloatArray,
        scan_index: ArrayLike | None,
        pose_covariances: ArrayLike | None,
        scan_origins: ArrayLike | None,
    ) -> SharedPose | None:
        """Check what the caller gave beside the ``points`` (N, 3); None when there is no shared pose error."""
        if scan_index is None and pose_covariances is None and scan_origins is None:
            return None
        if scan_index is None or pose_covariances is None:
            missing = "scan_index" if scan_index is None else "pose_covariances"
            raise ValueError(f"{missing}: expected it beside the other arguments of the shared pose error, got None")
        covariances = _pose_covariances(pose_covariances)
        scans = covariances.shape[0] * covariances.shape[1] // 6
        origins = np.zeros((scans, 3)) if scan_origins is None else as_shape("scan_origins", scan_origins, (scans, 3))
        return cls(_scan_index(scan_index, len(points), scans), _square_roots(covariances), origins).centred(points)

    def centred(self, points: FloatArray) -> SharedPose:
        """The same errors with every scan's rotations about the middle of its ``points`` (N, 3). Far from the point a
        scan turns about, shift and rotation are all but one: 1,000 km away too much so for floats."""
        counts = np.maximum(np.bincount(self.scan, minlength=len(self.origins)), 1)[:, None]
        lever = points - self.origins[self.scan]
        arms = np.stack([np.bincount(self.scan, lever[:, k], len(self.origins)) for k in range(3)], axis=1) / counts
        roots = self.roots_by_scan.copy()
        for angle, axis in ((3, (0.0, 0.0, 1.0)), (4, (0.0, 1.0, 0.0)), (5, (1.0, 0.0, 0.0))):
            roots[:, :3] += np.cross(axis, arms)[:, :, None] * roots[:, None, angle]
        return SharedPose(self.scan, roots.reshape(self.roots.shape), self.origins + arms)

    def select(self, chosen: np.ndarray) -> SharedPose:
        """The same for a subset of the points."""
        present, scan = np.unique(self.scan[chosen], return_inverse=True)
        roots = self.roots_by_scan[present]
        if self.is_joint:
            roots = roots.reshape(1, 6 * len(present), -1)
        return SharedPose(scan, roots, self.origins[present])

    @property
    def is_joint(self) -> bool:
        """Whether the scans' errors hang together."""
        return self.roots.shape[1] != 6 or len(self.roots) != len(self.origins)

    @property
    def roots_by_scan(self) -> FloatArray:
        """L by scan, shape (S, 6, M): xi_s = L_s u with u of unit covariance."""
        return self.roots.reshape(len(self.origins), 6, -1)


def _pose_covariances(value: ArrayLike) -> FloatArray:
    """Covariances (S, 6, 6), one for each scan, or the joint one of all scans as (1, 6 S, 6 S)."""
    if np.ndim(value) != 2:
        return as_covariance_stack("pose_covariances", value, 6)
    size = np.shape(value)[0]
    if size % 6 or not size:
        raise ValueError(f"pose_covariances: expected shape (S, 6, 6) or (6 S, 6 S), got {np.shape(value)}")
    return as_covariance("pose_covariances", value, size)[None]


def _scan_index(value: ArrayLike, n: int, scans: int) -> np.ndarray:
    index = np.asarray(value)
    if index.shape != (n,) or index.dtype.kind not in "iu":
        raise ValueError(f"scan_index: expected {n} integers, one for each point, got {index.dtype} of {index.shape}")
    if n and (index.min() < 0 or index.max() >= scans):
        raise ValueError(f"scan_index: expected indices of {scans} scans, got {index.min()}..{index.max()}")
    return np.ascontiguousarray(index, dtype=np.int64)


def _square_roots(covariances: FloatArray) -> FloatArray:
    """Roots L, S = L L^T, shape (K, N, M); M < N where no covariance of the stack says anything of some entries."""
    size = covariances.shape[-1]
    open_ = np.flatnonzero((covariances != 0.0).any(axis=(0, 1))) if len(covariances) == 1 else np.arange(size)
    values, vectors = np.linalg.eigh(covariances[:, open_[:, None], open_])
    roots = np.zeros((len(covariances), size, max(len(open_), 1)))
    roots[:, open_, : len(open_)] = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return roots


def fit_shared_pose(
    cloud: Cloud, viewpoint: FloatArray, shared: SharedPose, base: FloatArray
) -> tuple[int, FloatArray, FloatArray, float]:
    """Joint maximum likelihood of the plane and the scans' pose errors: outcome, frame, covariance and chi2. ``cloud``:
    points and covs as in the kernels; ``base``, (4, 4), the frame to start from, is moved to the optimum."""
    u = np.zeros((len(shared.roots), shared.roots.shape[2]))
    left, chi2 = np.eye(3), 0.0
    for _ in range(kernels.MAX_ITERATIONS):
        info, mixed, plane_side, pose_side, middle, cost = _normal_equations(cloud, shared, base, u)
        chi2 = cost + float(np.sum(u * u))
        coupling = mixed @ shared.roots
        open_side = (shared.roots.transpose(0, 2, 1) @ pose_side[..., None])[..., 0] - u
        sides = np.concatenate([coupling.transpose(0, 2, 1), open_side[..., None]], axis=2)
        try:
            solved = np.asarray(np.linalg.solve(middle, sides), dtype=np.float64)
        except np.linalg.LinAlgError:  # pose errors so large that one more than them is no more: rounding decides
            return OPEN_POSES, base, left, chi2
        information = (info - coupling @ solved[..., :3]).sum(axis=0)
        gradient = (plane_side - (coupling @ solved[..., 3:])[..., 0]).sum(axis=0)
        left = np.empty((3, 3))
        if not kernels.invert3(information[np.triu_indices(3)], left):
            return OPEN_POSES, base, left, chi2
        gradient -= 0.5 * _volume_gradient(cloud, shared, base, u, solved[..., :3], np.sqrt(np.diag(left)))
        step_b = left @ gradient
        step_u = solved[..., 3] - solved[..., :3] @ step_b
        u += step_u
        kernels.move_frame(base.copy(), (*step_b,), base)
        if gradient @ step_b < kernels.TOLERANCE and np.sum(step_u * step_u) < kernels.TOLERANCE:
            break
    return *_finish(cloud, viewpoint, base, left), chi2


def _normal_equations(
    cloud: Cloud, shared: SharedPose, base: FloatArray, u: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Sums of a Gauss-Newton step, by scan or stacked where their errors hang together; information on u; sum w r^2."""
    scans = len(shared.origins)
    info, mixed, pose = np.zeros((scans, 3, 3)), np.zeros((scans, 3, 6)), np.zeros((scans, 6, 6))
    plane_side, pose_side = np.zeros((scans, 3)), np.zeros((scans, 6))
    xi = (shared.roots @ u[..., None]).reshape(scans, 6)
    cost = _scan_sums(*cloud, shared.scan, shared.origins, base, xi, info, mixed, pose, plane_side, pose_side)
    pose_roots = (pose @ shared.roots_by_scan).reshape(shared.roots.shape)
    if shared.is_joint:  # the sums of a single scan whose pose error is those of all, stacked
        info, mixed = info.sum(axis=0)[None], mixed.transpose(1, 0, 2).reshape(1, 3, 6 * scans)
        plane_side, pose_side = plane_side.sum(axis=0)[None], pose_side.reshape(1, 6 * scans)
    middle = np.eye(u.shape[1]) + shared.roots.transpose(0, 2, 1) @ pose_roots
    return info, mixed, plane_side, pose_side, middle, cost


def _volume_gradient(
    cloud: Cloud, shared: SharedPose, base: FloatArray, u: FloatArray, follow: FloatArray, by: FloatArray
) -> FloatArray:
    """Derivative, by (z, theta, psi), of log det of the information on u, by central differences of ``by`` (3,).

    What the data say of the pose errors depends on where the plane is thought to be. Their best values alone would
    draw it to where they are told sharply, so they are integrated out (Laplace): that adds half this determinant, at
    the best u for each plane. Those go with it, by -``follow`` (., M, 3): at a u that stays, planes seem to be met at
    another slant than they are.
    """
    gradient, moved = np.empty(3), np.empty((4, 4))
    for k in range(3):
        volumes = []
        for sign in (1.0, -1.0):
            step = sign * by * np.eye(3)[k]
            kernels.move_frame(base, (*step,), moved)
            middle = _normal_equations(cloud, shared, moved, u - follow @ step)[4]
            volumes.append(np.linalg.slogdet(middle)[1].sum())
        gradient[k] = (volumes[0] - volumes[1]) / (2.0 * by[k])
    return gradient


def _finish(
    cloud: Cloud, viewpoint: FloatArray, base: FloatArray, left: FloatArray
) -> tuple[int, FloatArray, FloatArray]:
    """Outcome, frame and covariance at the optimum: ``left``, the inverse (3, 3) of the information on the slopes that
    the pose errors leave, and what the noise along the plane adds without pose errors."""
    sums, frame, to_p, covariance = np.zeros(N_SUMS), np.empty((4, 4)), np.empty((3, 3)), np.empty((3, 3))
    accumulate((*cloud, np.arange(len(cloud[0])), 0, len(cloud[0])), base, np.inf, sums)
    status = kernels.settle(base, sums, viewpoint, frame, to_p)
    if status == OK:
        status = kernels.write_covariance(sums, sums[4:10], to_p, covariance)
    if status == OK:
        plain = np.empty((3, 3))
        kernels.invert3(sums[4:10], plain)
        covariance += to_p @ (left - plain) @ to_p.T
        covariance = 0.5 * (covariance + covariance.T)
    return status, frame, covariance


def sp_pose_term(
    points: FloatArray, covs: FloatArray, shared: SharedPose, frame: FloatArray, spread: FloatArray
) -> FloatArray:
    """sum_s G_s S_s G_s^T, shape (3, 3): what the shared pose errors add to the covariance of the paper's fit."""
    local, (x_axis, y_axis, normal) = (points - frame[:3, 3]) @ frame[:3, :3], frame[:3, :3].T
    x, y, z = (local[:, k, None] for k in range(3))
    moves = np.stack((0.0 * z + normal, -(x * normal + z * x_axis), y * normal + z * y_axis), axis=1) / spread[:, None]
    arms = (points - shared.origins[shared.scan])[:, None]
    levers = np.concatenate((moves, np.cross(arms, moves)[..., ::-1]), axis=-1)  # as `lever`, of each
    derivative, traces = np.zeros((len(shared.origins), 3, 6)), np.trace(covs, axis1=1, axis2=2)
    np.add.at(derivative, shared.scan, levers / (traces**2)[:, None, None])
    if shared.is_joint:
        derivative = derivative.transpose(1, 0, 2).reshape(1, 3, -1)
    half = derivative @ shared.roots
    return np.einsum("sij,skj->ik", half, half)


@njit(cache=True)
def _scan_sums(points, covs, scan, origins, frame, xi, info, mixed, pose, plane_side, pose_side) -> float:
    """Sums of one Gauss-Newton step per scan: sum w f f^T, w f g^T, w g g^T, w r f, w r g; returns sum w r^2. r is the
    distance that the pose error leaves, f = (1, x, y) and g are those of the foot point that it implies."""
    x_axis, y_axis, normal, origin = column(frame, 0), column(frame, 1), column(frame, 2), column(frame, 3)
    g, f, cost = np.empty(6), np.ones(3), 0.0
    for i in range(points.shape[0]):
        s, c = scan[i], covs[min(i, covs.shape[0] - 1)]
        turn, q = (xi[s, 5], xi[s, 4], xi[s, 3]), minus(points[i], origins[s])
        # The point and its noise as they are once its scan's pose is corrected, p' = p - t - turn x q: with thousands
        # of points, weights half a percent off would pull harder than the few pose errors hold.
        seen = minus(normal, cross(normal, turn))
        spread = dot(c[0], seen), dot(c[1], seen), dot(c[2], seen)
        drawn = minus(spread, cross(turn, spread))
        p = minus(minus(minus(points[i], cross(turn, q)), xi[s]), origin)
        x, y, r = dot(x_axis, p), dot(y_axis, p), dot(normal, p)
        ux, uy, variance = dot(x_axis, drawn), dot(y_axis, drawn), dot(normal, drawn)
        least = FLOOR * (c[0, 0] + c[1, 1] + c[2, 2])
        if variance < least:
            variance, ux, uy, spread = least, 0.0, 0.0, (0.0, 0.0, 0.0)
        w = 1.0 / variance
        lever(normal, minus(q, (spread[0] * r * w, spread[1] * r * w, spread[2] * r * w)), g)
        f[1], f[2] = x - ux * r * w, y - uy * r * w
        cost += w * r * r
        for j in range(3):
            plane_side[s, j] += w * r * f[j]
            for k in range(3):
                info[s, j, k] += w * f[j] * f[k]
            for k in range(6):
                mixed[s, j, k] += w * f[j] * g[k]
        for j in range(6):
            pose_side[s, j] += w * r * g[j]
            for k in range(6):
                pose[s, j, k] += w * g[j] * g[k]
    return cost
