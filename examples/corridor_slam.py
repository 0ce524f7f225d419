"""Plane-based SLAM on a simulated corridor, from sensor data to a map with covariances, beside the truth.

A robot with drifting wheels drives 4 m down a corridor. A level 2D laser sees lines of its walls, a vertical one sweeps
out its surfaces; both become factors on the same plane landmarks. `run_slam` does everything; `PlaneSlam.add_keyframe`
underneath takes keyframes one by one, as a live system would give them: the last table is made that way.
"""

from itertools import islice

import numpy as np

from slam import PlaneSlam, SlamConfig
from slam.evaluation import absolute_error, facing_pairs, match_planes
from slam.frontend.keyframes import keyframes_of
from slam.planeslam import pose_symbol
from slam.runs.slam_run import path_length_m, run_slam
from slam.simulation import simulate_mission


def main() -> None:
    """Simulate, estimate, compare."""
    mission = simulate_mission("corridor", n_scans=160, seed=0)
    config = SlamConfig()
    run = run_slam(mission.log, mission.rig, config)
    print(f"{path_length_m(run.trajectory):.1f} m, {len(run.trajectory)} keyframes, {len(run.planes)} planes")

    print("\nposes                 position rmse   at the end   orientation rmse")
    for name, path in (("estimate", run.trajectory), ("odometry alone", run.odometry)):
        errors = absolute_error(path, mission.truth.trajectory, alignment="first")
        rmse_m, rmse_rad = np.sqrt(np.mean(errors.translation_m**2)), np.sqrt(np.mean(errors.rotation_rad**2))
        last_mm = 1e3 * errors.translation_m[-1]
        print(f"{name:20} {1e3 * rmse_m:11.1f} mm {last_mm:9.1f} mm {np.degrees(rmse_rad):13.3f} deg")

    first = mission.truth.poses_at(run.trajectory.stamps_ns[:1])[0]
    shown = [plane for plane in run.planes if plane.plane.outline is not None]
    moved = [plane.plane.transform(first) for plane in shown]  # the run starts at the origin, the truth does not
    print("\nlandmark  seen by       keyframes  points  distance error  predicted sigma  angle error")
    for match in match_planes(moved, mission.truth.planes):
        plane = shown[match.estimated]
        print(
            f"p{plane.id:<8} {'+'.join(plane.kinds):12} {plane.observations:10} {plane.plane.n_points:7}"
            f"  {1e3 * match.distance_m:+11.2f} mm  {1e3 * np.sqrt(plane.plane.covariance[0, 0]):12.2f} mm"
            f"  {np.degrees(match.angle_rad):7.3f} deg"
        )

    print("\nroom      estimate                truth")
    true_size = {"height": 2.7, "width": 2.268}
    for name, size in true_size.items():
        pair = next(pair for pair in facing_pairs(run.planes) if pair.name == name)
        print(f"{name:8} {pair.distance_m:8.4f} +- {pair.sigma_m:.4f} m   {size:8.4f} m")

    print("\nkeyframe  matched  new  sigma of x, y, heading")
    slam = PlaneSlam(config)
    for keyframe in islice(keyframes_of(mission.log, mission.rig, config), 5):
        report = slam.add_keyframe(keyframe)
        verdicts = [decision.verdict for decision in report.decisions]
        sigmas = np.sqrt(np.diag(slam.marginal_covariance(pose_symbol(report.keyframe))))  # (rx, ry, rz, x, y, z)
        print(
            f"{report.keyframe:8} {verdicts.count('match'):8} {verdicts.count('new'):4}  {1e3 * sigmas[3]:.2f} mm,"
            f" {1e3 * sigmas[4]:.2f} mm, {np.degrees(sigmas[2]):.4f} deg"
        )


if __name__ == "__main__":
    main()
