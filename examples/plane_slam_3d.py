"""SLAM with a spinning 3D laser: planes of every scan, matched by chi2, in one graph with drifting wheels.

The scene is a simulated hall with pillars, crates, columns and a pitched roof; the robot drives 7 m of it. A scan of
32 rings becomes planes with covariances, each plane a factor on a landmark, and the landmarks the map. At the end the
map goes into a folder as files that other tools read, and a page that shows it.
"""

import tempfile
from pathlib import Path

import numpy as np

from slam import SlamConfig
from slam.evaluation import absolute_error, match_planes
from slam.files import new_folder
from slam.output.export import export_run
from slam.output.run_files import write_run
from slam.runs.slam_run import run_slam
from slam.simulation import simulate_mission


def main() -> None:
    """Drive, estimate, compare, hand over."""
    mission = simulate_mission("hall", n_scans=15, seed=0)
    run = run_slam(mission.log, mission.rig, SlamConfig())
    print(f"{len(run.trajectory)} scans, {len(run.planes)} planes")

    for name, path in (("estimate", run.trajectory), ("odometry alone", run.odometry)):
        errors = absolute_error(path, mission.truth.trajectory, alignment="first")
        print(f"{name:15} position rmse {1e3 * np.sqrt(np.mean(errors.translation_m**2)):6.1f} mm")

    first = mission.truth.poses_at(run.trajectory.stamps_ns[:1])[0]
    matches = match_planes([plane.plane.transform(first) for plane in run.planes], mission.truth.planes)
    off = np.array([abs(match.distance_m) for match in matches])
    print(f"{len(matches)} of them are true planes, off by {1e3 * np.median(off):.1f} mm in the median")

    with tempfile.TemporaryDirectory() as scratch:
        with new_folder(Path(scratch) / "run") as folder:
            write_run(run, folder, title="a hall")
        for name in ("planes.glb", "graph.g2o", "trajectory.kitti"):
            export_run(Path(scratch) / "run", Path(scratch) / name)
            print(f"{name}: {(Path(scratch) / name).stat().st_size / 1024:.0f} KB")


if __name__ == "__main__":
    main()
