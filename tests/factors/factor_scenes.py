"""What the factor tests share: random scenes, perturbed measurements, numerical derivatives."""

import gtsam
import numpy as np

from spplanes import Plane, ScanLine
from tests.statistics import central_differences

X, A, L = (gtsam.symbol(c, 0) for c in "xal")

#: Normals at which two components tie, or vanish: where Unit3's basis jumps.
TIED_NORMALS = np.array(
    [
        [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1],
        [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, -1, 0], [-1, 0, 1], [0, -1, -1],
        [1, 1, 1], [-1, 1, -1], [0.5, 0.5, 0.7071], [0.5, 0.7071, 0.5], [0.7071, 0.5, 0.5], [0.6, 0.6, -0.53],
    ]
)  # fmt: skip
TIED_NORMALS = TIED_NORMALS / np.linalg.norm(TIED_NORMALS, axis=1)[:, None]


def random_normals(rng: np.random.Generator, n: int) -> np.ndarray:
    normals = rng.normal(size=(n, 3))
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def random_pose(rng: np.random.Generator, scale: float = 3.0) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Rodrigues(rng.normal(size=3)), rng.uniform(-scale, scale, 3))


def frame_of(normal: np.ndarray, centre: np.ndarray, turn: float) -> np.ndarray:
    """Plane frame with the given normal and origin, its x axis turned by ``turn``."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0
    u = np.cross(axis, normal)
    u /= np.linalg.norm(u)
    x = np.cos(turn) * u + np.sin(turn) * np.cross(normal, u)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
    frame[:3, 3] = centre
    return frame


def random_covariance(rng: np.random.Generator, sigmas: np.ndarray, correlation: float = 0.7) -> np.ndarray:
    """Full covariance with the given standard deviations and strong cross terms, up to 0.98."""
    root = np.eye(len(sigmas)) + correlation * rng.uniform(-1, 1, (len(sigmas), len(sigmas)))
    raw = root @ root.T
    scale = np.sqrt(np.diag(raw))
    mixed = 0.98 * raw / np.outer(scale, scale) + 0.02 * np.eye(len(sigmas))
    return mixed * np.outer(sigmas, sigmas)


def perturbed(frame: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Plane frame composed on the right with the SP perturbation p = (z, theta, psi)."""
    z, theta, psi = p
    step = np.eye(4)
    step[:3, :3] = gtsam.Rot3.RzRyRx(psi, theta, 0.0).matrix()
    step[2, 3] = z
    return frame @ step


def random_plane(rng: np.random.Generator, normal: np.ndarray | None = None) -> Plane:
    normal = random_normals(rng, 1)[0] if normal is None else normal
    frame = frame_of(normal, rng.uniform(-3, 3, 3), rng.uniform(0, 2 * np.pi))
    sigmas = np.array([0.01, np.radians(0.05), np.radians(1.0)])
    return Plane(frame=frame, covariance=random_covariance(rng, sigmas))


def random_line(rng: np.random.Generator) -> ScanLine:
    alpha, rho = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 5.0)
    return make_line(alpha, rho, random_covariance(rng, np.array([0.01, 0.02])))


def make_line(alpha: float, rho: float, covariance: np.ndarray) -> ScanLine:
    c, s = np.cos(alpha), np.sin(alpha)
    ends = rho * np.array([c, s]) + np.array([[-1.0], [1.0]]) * np.array([-s, c])
    return ScanLine(alpha=alpha, rho=rho, covariance=covariance, endpoints=ends, indices=np.arange(2))


def values_of(**named: object) -> gtsam.Values:
    values = gtsam.Values()
    for name, value in named.items():
        values.insert(gtsam.symbol(name[0], int(name[1:] or 0)), value)  # type: ignore[call-overload]
    return values


def graph_of(*factors: gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def assert_jacobian(factor: gtsam.NoiseModelFactor, values: gtsam.Values, *, tolerance: float = 1e-6) -> None:
    """Whitened derivative against central differences through ``retract``, relative to its largest entry."""
    keys = list(factor.keys())
    ends = np.cumsum([len(values.zeroVectors().at(key)) for key in keys])

    def moved(step: np.ndarray) -> np.ndarray:
        steps = gtsam.VectorValues()
        for key, part in zip(keys, np.split(step, ends[:-1]), strict=True):
            steps.insert(key, part)
        return factor.whitenedError(values.retract(steps))

    (analytic, b), numeric = factor.linearize(values).jacobian(), central_differences(moved, np.zeros(ends[-1]))
    scale = max(1.0, float(np.abs(numeric).max()))
    np.testing.assert_allclose(analytic / scale, numeric / scale, atol=tolerance)
    np.testing.assert_allclose(-b, factor.whitenedError(values), atol=1e-9 * scale)
