"""Plane fits with covariance beside plain numpy, and beside the uncertainty-free fits of Open3D and mrob.

Run as ``python -m benchmarks fit``. One thread. Accuracy is the angle between the normal and the true one and the
distance of the true plane's middle from the plane; of many planes their medians, and the mean NEES of those fits that
have a covariance (3 is right).
"""

from collections.abc import Callable
from functools import cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks._measure import Case, Peer, Row, Task, measured
from benchmarks.peers import environment
from spplanes import Plane, fit_plane, fit_planes
from spplanes.fitting.fit import Method

POINTS = 1_000_000
PLANES, FEWER, PER_PLANE = 10_000, 2_000, 100
SIGMA_M = 0.015
#: Frame of the true wall.
CENTRE, X, Y = np.array([4.0, 1.0, 0.2]), np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
NORMAL = np.cross(X, Y)


@cache
def wall(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and covariances (n, 3, 3) of an oblique wall seen by a laser: range noise 15 mm, across 2 mrad."""
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)])
    points = CENTRE + flat[:, :1] * X + flat[:, 1:] * Y
    ranges = np.linalg.norm(points, axis=1)
    beams = points / ranges[:, None]
    along, sideways = beams[:, :, None] * beams[:, None, :], 0.002 * ranges
    covariances = SIGMA_M**2 * along + (sideways**2)[:, None, None] * (np.eye(3) - along)
    across = rng.normal(size=(n, 3))
    across -= np.einsum("ni,ni->n", across, beams)[:, None] * beams
    return points + SIGMA_M * rng.normal(size=(n, 1)) * beams + sideways[:, None] * across, covariances


def sp_numpy(points: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The formulas of ``method="sp"`` in straightforward numpy: axes x y n, centre and covariance."""
    w = 1.0 / np.trace(covariances, axis1=1, axis2=2) ** 2
    centre = w @ points / w.sum()
    q = points - centre
    values, axes = np.linalg.eigh((w[:, None] * q).T @ q)
    n, y, x = axes[:, 0], axes[:, 1], axes[:, 2]
    local = q @ axes
    rows = np.stack([np.broadcast_to(n, q.shape), *(np.outer(local[:, k], n) for k in (2, 1))], axis=1)
    rows[:, 1] += np.outer(local[:, 0], x)
    rows[:, 2] += np.outer(local[:, 0], y)
    middle = np.einsum("n,nij,njk,nlk->il", w * w, rows, covariances, rows, optimize=True)
    scale = np.array([1.0 / w.sum(), -1.0 / (values[2] - values[0]), 1.0 / (values[1] - values[0])])
    return np.column_stack([x, y, n]), centre, scale[:, None] * middle * scale


def ml_numpy(points: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The formulas of ``method="ml"`` in straightforward numpy: axes x y n, centre and covariance."""
    w = 1.0 / np.trace(covariances, axis1=1, axis2=2)
    origin = w @ points / w.sum()
    q = points - origin
    axes = np.linalg.eigh((w[:, None] * q).T @ q)[1][:, ::-1]
    while True:
        local = (points - origin) @ axes
        noise = np.einsum("ji,njk,kl->nil", axes, covariances, axes, optimize=True)
        w = 1.0 / noise[:, 2, 2]
        feet = local - noise[:, :, 2] * (w * local[:, 2])[:, None]
        h = np.column_stack([np.ones(len(points)), feet[:, :2]])
        information, gradient = h.T @ (w[:, None] * h), h.T @ (w * local[:, 2])
        b = np.linalg.solve(information, gradient)
        if b @ gradient < 1e-10:
            break
        origin = origin + b[0] * axes[:, 2]
        axes = np.linalg.qr(np.column_stack([axes[:, 2] - axes[:, :2] @ b[1:], axes[:, :2]]))[0][:, [1, 2, 0]]
    along = noise[:, :2, :2] - np.einsum("ni,nj,n->nij", noise[:, :2, 2], noise[:, :2, 2], w)
    curvature = information.copy()
    curvature[1:, 1:] -= np.einsum("n,nij->ij", w, along)
    inverse = np.linalg.inv(curvature)
    return axes, origin, inverse @ information @ inverse


def numpy_normals(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals and centres of groups of points (K, n, 3) all at once, without uncertainty."""
    centres = points.mean(axis=1)
    q = points - centres[:, None]
    return np.linalg.eigh(np.einsum("kni,knj->kij", q, q))[1][:, :, 0], centres


def open3d_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals and centres of groups of points (K, n, 3) by Open3D, which has each cloud copied to it."""
    import open3d

    clouds = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(part)) for part in points)
    found = [cloud.compute_mean_and_covariance() for cloud in clouds]
    return np.linalg.eigh(np.stack([c for _, c in found]))[1][:, :, 0], np.stack([m for m, _ in found])


def score(normals: np.ndarray, middle_offsets: np.ndarray) -> Row:
    """Accuracy of planes with normals (K, 3) that pass the true middle at these distances (K,)."""
    angle = 1e3 * float(np.rad2deg(np.median(np.linalg.norm(np.cross(normals, NORMAL), axis=1))))
    return {"normal, mdeg": angle, "offset, um": 1e6 * float(np.median(np.abs(middle_offsets))), "NEES (3)": None}


def score_planes(planes: list[Plane]) -> Row:
    row = score(np.stack([p.normal for p in planes]), np.array([p.distance(CENTRE) for p in planes]).ravel())
    return row | {"NEES (3)": float(np.mean([nees(plane) for plane in planes]))}


def nees(plane: Plane) -> float:
    """Normalised error squared of (z, theta, psi) against the true wall."""
    x, y, n = plane.frame[:3, :3].T
    slope = NORMAL / (NORMAL @ n)
    error = np.array([slope @ (CENTRE - plane.centre), slope @ x, -(slope @ y)])
    return float(error @ np.linalg.solve(plane.covariance, error))


def score_numpy(found: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Row:
    """Accuracy of planes by numpy: axes, point of it, covariance of each."""
    frames = np.broadcast_to(np.eye(4), (len(found), 4, 4)).copy()
    frames[:, :3, :3], frames[:, :3, 3] = [one[0] for one in found], [one[1] for one in found]
    return score_planes([Plane(frame, one[2]) for frame, one in zip(frames, found, strict=True)])


def score_groups(found: tuple[np.ndarray, np.ndarray]) -> Row:
    normals, centres = found
    return score(normals, np.einsum("ki,ki->k", normals, CENTRE - centres))


def mrob_fits(points: np.ndarray, repeats: int) -> Row:
    """The row of mrob's fit, by its own interpreter; groups of points (K, n, 3)."""
    found = environment.call("mrob_fit", {"points": points}, str(repeats))
    planes = np.array(found.pop("planes"))
    return score(planes[:, :3], planes[:, :3] @ CENTRE + planes[:, 3]) | found


def with_covariances(method: Method) -> list[Task | Peer]:
    """A million points with a covariance each."""
    points, covariances = wall(POINTS)
    by_numpy = {"sp": sp_numpy, "ml": ml_numpy}[method]
    return [
        Task("spplanes", partial(fit_plane, points, covariances, method=method), lambda one: score_planes([one])),
        Task("plain numpy", partial(by_numpy, points, covariances), lambda one: score_numpy([one]), repeats=3),
    ]


def robust() -> list[Task | Peer]:
    """What robustness costs on top of it."""
    tukey = partial(fit_plane, *wall(POINTS), robust="tukey")
    return [with_covariances("ml")[0], Task("spplanes, tukey", tukey, lambda one: score_planes([one]))]


def one_sigma(planes: int, each: int) -> list[Task | Peer]:
    """Fits that others have as well: no covariances; ours gives one all the same."""
    points = wall(POINTS)[0]
    groups = points[: planes * each].reshape(planes, each, 3)
    labels = np.repeat(np.arange(planes), each)
    ours: Callable[[], Any] = partial(fit_planes, points[: planes * each], labels=labels, sigma=SIGMA_M)
    if planes == 1:
        ours = partial(lambda p: [fit_plane(p, sigma=SIGMA_M)], points[:each])
    contenders: list[Task | Peer] = [
        Task("spplanes, with covariance", ours, score_planes),
        Task("plain numpy", partial(numpy_normals, groups), score_groups),
    ]
    if find_spec("open3d"):
        contenders.append(Task("Open3D", partial(open3d_planes, groups), score_groups))
    return [*contenders, Peer("mrob", partial(mrob_fits, groups))]


def many() -> list[Task | Peer]:
    """Planes of a hundred points each, with covariances; so few that plain numpy is done in a second."""
    points, covariances = (part[: FEWER * PER_PLANE] for part in wall(POINTS))
    labels = np.repeat(np.arange(FEWER), PER_PLANE)
    shuffled = np.random.default_rng(1).permutation(labels)

    def one_by_one() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        parts = zip(points.reshape(FEWER, -1, 3), covariances.reshape(FEWER, -1, 3, 3), strict=True)
        return [ml_numpy(*part) for part in parts]

    return [
        Task("spplanes, ml", partial(fit_planes, points, covariances, labels), score_planes),
        Task("spplanes, ml, shuffled", partial(fit_planes, points, covariances, shuffled), score_planes),
        Task("spplanes, sp", partial(fit_planes, points, covariances, labels, method="sp"), score_planes),
        Task("plain numpy, ml", one_by_one, score_numpy, repeats=1),
    ]


CASES: dict[str, Case] = {
    "1,000,000 points with covariances, ml": partial(with_covariances, "ml"),
    "1,000,000 points with covariances, sp": partial(with_covariances, "sp"),
    "the same, robust": robust,
    "1,000,000 points, one sigma": partial(one_sigma, 1, POINTS),
    "10,000 planes of 100 points, one sigma": partial(one_sigma, PLANES, PER_PLANE),
    "2,000 planes of 100 points with covariances": many,
}


def run(*, short: bool = False) -> list[Row]:
    return measured("benchmarks.fit", CASES, short=short)
