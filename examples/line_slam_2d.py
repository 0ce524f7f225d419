"""SLAM with a level 2D laser alone: lines of the walls of a room, wheels that drift, and a map of the walls.

A line seen by a 2D laser is rank-2 information on a plane. How a wall leans, a level laser does not see: that is what
`landmarks.wall_tilt_sigma_rad` states. Everything else is as with 3D data: the same landmarks, the same factors, the
same tests of chi2. The robot drives round the room once; its wheels turn the room by degrees, its walls hold it still.
"""

import numpy as np

from slam import SlamConfig
from slam.evaluation import absolute_error
from slam.geometry.polygons import segments_of
from slam.runs.slam_run import run_slam
from slam.simulation import HORIZONTAL, simulate_mission


def main() -> None:
    """Drive, estimate, compare."""
    mission = simulate_mission("room", seed=0)
    rig = mission.rig.model_copy(update={"sensors": {HORIZONTAL: mission.rig.sensors[HORIZONTAL]}})
    run = run_slam(mission.log, rig, SlamConfig())

    print("poses           position rmse   orientation rmse")
    for name, path in (("estimate", run.trajectory), ("odometry alone", run.odometry)):
        errors = absolute_error(path, mission.truth.trajectory, alignment="first")
        rmse_m, rmse_rad = np.sqrt(np.mean(errors.translation_m**2)), np.sqrt(np.mean(errors.rotation_rad**2))
        print(f"{name:15} {1e3 * rmse_m:10.1f} mm {np.degrees(rmse_rad):14.3f} deg")

    print("\nwall  faces     distance             length  keyframes")
    for wall in run.planes:
        facing = np.degrees(np.arctan2(wall.plane.normal[1], wall.plane.normal[0]))
        length = max(float(np.ptp(chain, axis=0).max()) for chain in segments_of(wall.seen))
        sigma = np.sqrt(wall.plane.covariance[0, 0])
        d, seen = wall.plane.d, wall.observations
        print(f"p{wall.id:<4} {facing:6.1f} deg {d:8.4f} +- {sigma:.4f} m {length:7.2f} m {seen:9}")

    for row in run.slam.audit.summary():
        print(f"\nNIS per degree of freedom: {row.mean_per_dof:.2f} ({row.low:.2f} to {row.high:.2f}: {row.verdict})")


if __name__ == "__main__":
    main()
