"""Buildings as exact planes with a joint covariance of one's own making."""

from collections.abc import Sequence

import numpy as np

from benchmarks.corpus.suite import Door, Suite, SuiteRoom
from slam.floorplan import JointPlanes
from slam.geometry.frames import settle_frame
from slam.map.map_planes import MapPlane
from spplanes import Plane

#: A corridor 2 m wide with a room above and one below; doors 0.9 and 1 m; walls 0.2 m; 2.5 m high.
SUITE = Suite(
    SuiteRoom(0.0, -1.0, 6.0, 1.0),
    (SuiteRoom(0.0, 1.2, 4.0, 4.2, Door(1.0, 1.9, 2.05)), SuiteRoom(0.0, -4.7, 5.0, -1.2, Door(3.0, 4.0, 2.05))),
    0.2,
    0.1,
    2.5,
)


def planes_of(floor_m: float = 0.0) -> list[Plane]:
    """The true planes of the suite."""
    return SUITE.world(floor_m).planes


def joint_of(planes: Sequence[Plane], *, sigma: float = 1e-3, seed: int = 0) -> JointPlanes:
    """Planes with correlated errors of about this size: of d in m, of the normals in half as many radians."""
    rng = np.random.default_rng(seed)
    hesse = np.array([[*plane.normal, plane.d] for plane in planes])
    tangent = rng.standard_normal((3 * len(planes), 3 * len(planes))) / np.sqrt(3 * len(planes))
    tangent *= sigma * np.tile([0.5, 0.5, 1.0], len(planes))[:, None]
    jacobian = np.zeros((4 * len(planes), 3 * len(planes)))
    for k, plane in enumerate(planes):
        jacobian[4 * k : 4 * k + 3, 3 * k : 3 * k + 2] = plane.frame[:3, :2]
        jacobian[4 * k + 3, 3 * k + 2] = 1.0
    root = jacobian @ tangent
    shown = tuple(MapPlane(k, plane, plane.outline, 5, ("plane",)) for k, plane in enumerate(planes))  # type: ignore
    return JointPlanes(shown, hesse, root @ root.T)


def moved(joint: JointPlanes, errors: np.ndarray) -> JointPlanes:
    """The same building measured with errors of (normal, d), shape (P, 4)."""
    hesse = joint.hesse + errors
    hesse[:, :3] /= np.linalg.norm(hesse[:, :3], axis=1, keepdims=True)
    shown = []
    for one, (*normal, d) in zip(joint.planes, hesse.tolist(), strict=True):
        frame = settle_frame(one.plane.frame, np.array(normal), d)
        plane = Plane(frame, np.zeros((3, 3)), one.plane.n_points, one.plane.outline)
        shown.append(MapPlane(one.id, plane, one.seen, one.observations, one.kinds))
    return JointPlanes(tuple(shown), hesse, joint.covariance)
