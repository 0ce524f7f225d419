"""Planes in somebody else's pose graph: read a g2o file, add plane factors in three lines, get planes with covariance.

The pose graph is one of those that come with GTSAM. Its poses look at a room that is simulated here: what counts are
the three lines marked (1), (2) and (3), and what comes out.
"""

from __future__ import annotations

import gtsam
import numpy as np

from factors import isam2_parameters, plane_factors, plane_landmark, settle, world_plane
from spplanes import Plane, fit_plane

#: Walls, floor and ceiling of the room: normal into the room, and distance n.x = d, m.
ROOM = {
    "floor": (np.array([0.0, 0.0, 1.0]), -3.0),
    "ceiling": (np.array([0.0, 0.0, -1.0]), -6.0),
    "left": (np.array([0.0, -1.0, 0.0]), -9.0),
    "front": (np.array([-1.0, 0.0, 0.0]), -9.0),
}
SIGMA_M = 0.01


def seen_from(world_T_body: gtsam.Pose3, normal: np.ndarray, d: float, rng: np.random.Generator) -> Plane:
    """What a depth sensor makes of 200 noisy points of a patch of a wall: a plane in its own frame, with covariance."""
    span = np.linalg.svd(normal[None])[2][1:]
    world = d * normal + rng.uniform(-2.0, 2.0, (200, 2)) @ span + SIGMA_M * rng.normal(size=(200, 1)) * normal
    points = world_T_body.transformTo(world.T).T
    return fit_plane(points, sigma=SIGMA_M, viewpoint=np.zeros(3))


def main() -> None:
    """Solve a pose graph without and with planes, and print what the planes change."""
    rng = np.random.default_rng(0)
    graph, values = gtsam.readG2o(gtsam.findExampleDataFile("pose3example.txt"), True)
    keys = list(gtsam.utilities.allPose3s(values).keys())
    graph.addPriorPose3(keys[0], values.atPose3(keys[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))
    truth = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    before = gtsam.Marginals(graph, truth)

    walls = list(ROOM.values())
    seen = [(key, j, seen_from(truth.atPose3(key), *walls[j], rng)) for key in keys for j in range(len(walls))]
    poses, planes = [key for key, _, _ in seen], [plane for _, _, plane in seen]
    landmarks = [gtsam.symbol("l", j) for _, j, _ in seen]

    # (1) the factors, every landmark in the frame of the first pose
    graph.push_back(plane_factors(planes, poses, landmarks, [keys[0]] * len(planes)))
    # (2) their initial values, as the first pose sees them
    for j in range(len(walls)):
        values.insert(gtsam.symbol("l", j), plane_landmark(planes[j]))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    # (3) the planes, in the world, with covariance
    after = gtsam.Marginals(graph, result)
    maps = {name: world_plane(result, after, gtsam.symbol("l", j), anchor_key=keys[0]) for j, name in enumerate(ROOM)}

    # the same by iSAM2: its own parameters would leave planes linearised far off
    isam = gtsam.ISAM2(isam2_parameters())
    isam.update(graph, values)
    settle(isam)
    gaps = [isam.calculateEstimatePose3(key).range(result.atPose3(key)) for key in keys]

    for key in keys[1:]:
        loose, firm = (np.sqrt(np.trace(m.marginalCovariance(key)[3:, 3:])) for m in (before, after))
        print(f"pose {key}: position known to {1e3 * loose:7.1f} mm without planes, {1e3 * firm:5.1f} mm with them")
    print(f"iSAM2 puts the poses where the batch does, to {1e3 * max(gaps):.4f} mm")
    for name, plane in maps.items():
        z, theta, psi = np.sqrt(np.diag(plane.covariance))
        tilt = np.degrees(np.hypot(theta, psi))
        print(f"{name:8s} d = {plane.d:7.4f} m ({ROOM[name][1]:4.1f}), z +- {1e3 * z:.2f} mm, tilt +- {tilt:.4f} deg")


if __name__ == "__main__":
    main()
