"""A room with a box in it, seen from one pose that is uncertain: for association with known answers."""

from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from scipy.linalg import block_diag
from shapely import box

from factors import Association, AssociationGates, LandmarkExtents, LineObservation, Prediction, associate
from spplanes import Plane, ScanLine
from tests.factors.factor_scenes import perturbed, values_of

X = gtsam.symbol("x", 0)

#: (normal, distance, centre of the patch, half width, half height): four walls, floor, and the faces of a cabinet.
ROOM = (
    ((-1.0, 0.0, 0.0), -4.0, (4.0, 0.0, 0.0), 2.8, 1.2),
    ((1.0, 0.0, 0.0), -4.0, (-4.0, 0.0, 0.0), 2.8, 1.2),
    ((0.0, -1.0, 0.0), -3.0, (0.0, 3.0, 0.0), 3.8, 1.2),
    ((0.0, 1.0, 0.0), -3.0, (0.0, -3.0, 0.0), 3.8, 1.2),
    ((0.0, 0.0, 1.0), -1.2, (0.0, 0.0, -1.2), 3.8, 2.8),
    ((-1.0, 0.0, 0.0), -3.4, (3.4, 1.5, -0.6), 0.5, 0.6),
    ((0.0, -1.0, 0.0), -2.6, (-2.0, 2.6, -0.3), 0.6, 0.9),
)
MEASURED = np.diag([2e-3, 3e-3, 3e-3]) ** 2
MAPPED = np.diag([3e-3, 2e-3, 2e-3]) ** 2
#: Key of a landmark, by its number.
key = partial(gtsam.symbol, "l")


def frame_of(normal: tuple[float, ...], centre: tuple[float, ...]) -> np.ndarray:
    """Plane frame: z the normal, x level (of the floor along the world's x)."""
    z = np.array(normal)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[2]) > 0.5 else np.cross([0.0, 0.0, 1.0], z)
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    frame[:3, 3] = centre
    return frame


def plane_of(number: int, covariance: np.ndarray = MEASURED, n_points: int = 0) -> Plane:
    """A surface of the room in the world."""
    normal, _, centre, width, height = ROOM[number]
    return Plane(frame_of(normal, centre), covariance, n_points or 1000 - number, box(-width, -height, width, height))


def drawn(plane: Plane, covariance: np.ndarray, rng: np.random.Generator) -> Plane:
    """A plane with an error of its covariance: z along its normal, theta about y, psi about x."""
    frame = perturbed(plane.frame, rng.multivariate_normal(np.zeros(3), covariance))
    return Plane(frame, covariance, plane.n_points, plane.outline)


def tangent_covariance(plane: Plane) -> np.ndarray:
    """Covariance of a plane in the world in GTSAM's tangent of its landmark, shape (3, 3)."""
    normal = plane.normal
    basis = gtsam.Unit3(normal).basis()
    jacobian = np.zeros((3, 4))
    jacobian[:2, :3], jacobian[2, 3] = basis.T, -1.0
    return jacobian @ plane.hesse_covariance @ jacobian.T


@dataclass(frozen=True, eq=False)
class Scene:
    """A pose that is predicted and a map, both with errors of their covariances; the truth is the room's."""

    values: gtsam.Values
    keys: list[int]
    covariance: np.ndarray
    landmarks: LandmarkExtents
    truth: gtsam.Pose3

    @property
    def prediction(self) -> Prediction:
        """By the matrix."""
        return Prediction.of_matrix(self.covariance, self.keys, self.values, X)

    def seen(self, number: int, rng: np.random.Generator, covariance: np.ndarray = MEASURED) -> Plane:
        """What the true pose measures of a surface."""
        here = plane_of(number).transform(self.truth.inverse().matrix())
        return drawn(here, covariance, rng)

    def line(self, number: int, rng: np.random.Generator) -> LineObservation:
        """What a level laser at the body measures of a wall: 2 mm, 3 mrad."""
        here = plane_of(number).transform(self.truth.inverse().matrix())
        across = -here.normal[:2] / np.linalg.norm(here.normal[:2])
        alpha, rho = float(np.arctan2(across[1], across[0])), -here.d / float(np.linalg.norm(here.normal[:2]))
        along = np.array([-across[1], across[0]])
        middle = float(here.centre[:2] @ along)
        turn, shift = rng.normal(size=2) * (3e-3, 2e-3)
        by_middle = np.array([[1.0, 0.0], [middle, 1.0]])  # (turn, shift at the middle) to (alpha, rho)
        covariance = by_middle @ np.diag([3e-3, 2e-3]) ** 2 @ by_middle.T
        alpha, rho = alpha + turn, rho + shift + middle * turn
        outward, along = np.array([np.cos(alpha), np.sin(alpha)]), np.array([-np.sin(alpha), np.cos(alpha)])
        ends = rho * outward + np.outer((middle - 0.4, middle + 0.4), along)
        return LineObservation(ScanLine(alpha, rho, covariance, ends, np.arange(40)), np.eye(4))


def scene(pose_covariance: np.ndarray, rng: np.random.Generator, mapped: tuple[int, ...] = tuple(range(7))) -> Scene:
    """A robot at about the middle of the room whose map knows some of its surfaces; all errors drawn."""
    truth = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([0.2, -0.4, 0.0]))
    predicted = truth.retract(rng.multivariate_normal(np.zeros(6), pose_covariance))
    values, landmarks, blocks = values_of(x0=predicted), LandmarkExtents(), [pose_covariance]
    origin = values_of(x0=gtsam.Pose3())
    for number in mapped:
        plane = drawn(plane_of(number), MAPPED, rng)
        values.insert(key(number), landmarks.start(key(number), plane, X, origin))
        landmarks[key(number)].pose_keys.add(-1)  # seen before
        blocks.append(tangent_covariance(plane))
    return Scene(values, [X, *map(key, mapped)], block_diag(*blocks), landmarks, truth)


def scene_off_ahead(off_m: float, rng: np.random.Generator, mapped: tuple[int, ...], sigma_m: float = 0.25) -> Scene:
    """A robot that is so far off along the world's x, where it is known to a standard deviation."""
    place = scene(np.diag([1e-3, 1e-3, 3e-3, sigma_m, 0.01, 1e-3]) ** 2, rng, mapped)
    place.values.update(X, gtsam.Pose3(place.truth.rotation(), place.truth.translation() + np.array([off_m, 0.0, 0.0])))
    axis = gtsam.Pose3(place.truth.rotation(), np.zeros(3)).inverse().AdjointMap()
    place.covariance[:6, :6] = axis @ place.covariance[:6, :6] @ axis.T  # along the world's axes
    return place


def asked(scene: Scene, observations: list, **how: object) -> Association:
    """What the observations are; what is less probable than all else is unsure."""
    gates = AssociationGates(**how)  # type: ignore[arg-type]
    return associate(observations, scene.prediction, scene.landmarks, gates=gates, least_probability=0.5)
