"""A map for Open3D: mesh, lines, ellipsoids and coloured points, as objects and as files; no window needed.

The map is that of a short simulated mission. Everything is written to a temporary folder and read back, to show that
it is ordinary Open3D geometry. Without Open3D the example says so and ends.
"""

import tempfile
from pathlib import Path

import numpy as np

from slam import SlamConfig
from slam.runs.history import History
from slam.runs.slam_run import run_slam
from slam.simulation import VERTICAL, simulate_mission
from slam.visualization.open3d_export import (
    ellipsoids_to_lines,
    outlines_to_lines,
    planes_to_mesh,
    points_to_cloud,
    trajectory_to_lines,
)
from slam.visualization.pictures import position_covariances
from spplanes import segment_scans
from spplanes.noise import SensorModel
from spplanes.registration import register_scans


def main() -> None:
    """Make a map and hand it over."""
    try:
        import open3d as o3d
    except (ImportError, OSError) as error:
        print(f"Open3D is not here ({error}): pip install spplanes[open3d], apt-get install libusb-1.0-0")
        return
    mission = simulate_mission("corridor", n_scans=120, seed=1)
    run = run_slam(mission.log, mission.rig, SlamConfig())
    mesh = planes_to_mesh(run.planes, colour_by="sigma")
    outlines, path = outlines_to_lines(run.planes), trajectory_to_lines(run.trajectory, rgb=(0.8, 0.1, 0.1))
    print(f"legacy: {mesh}, {mesh.get_surface_area():.1f} m2; {outlines}; {path}")
    ellipsoids = ellipsoids_to_lines(*position_covariances(run, History.of(run.planes, run.slam)), scale=50.0)
    print(f"where the robot was, 95 %, enlarged 50 times: {ellipsoids}")

    tensor = planes_to_mesh(run.planes, tensor=True)
    sigmas_mm = 1e3 * tensor.vertex["sigma_m"].numpy().ravel()
    ids = np.unique(tensor.vertex["plane"].numpy())
    print(f"tensor: {len(ids)} planes; corners are known to {sigmas_mm.min():.2f} .. {sigmas_mm.max():.2f} mm")

    scans, sensor = mission.arrays(VERTICAL), mission.rig.sensors[VERTICAL]
    model = SensorModel(range_sigma_m=sensor.range_sigma_m)
    bodies = scans.world_T_body_given
    placed = register_scans(scans.ranges, scans.angles, bodies, model, body_T_sensor=sensor.body_T_sensor)
    labels, _ = segment_scans(placed.points, placed.covariances, viewpoints=placed.viewpoints)
    cloud = points_to_cloud(placed.points, labels)
    print(f"points by plane: {cloud}, {100 * (labels >= 0).mean():.1f} % of them on a plane")

    with tempfile.TemporaryDirectory() as folder:
        for name, write, read, geometry in (
            ("planes.ply", o3d.io.write_triangle_mesh, o3d.io.read_triangle_mesh, mesh),
            ("outlines.ply", o3d.io.write_line_set, o3d.io.read_line_set, outlines),
            ("points.ply", o3d.io.write_point_cloud, o3d.io.read_point_cloud, cloud),
        ):
            file = Path(folder) / name
            write(file, geometry)
            print(f"{name}: {file.stat().st_size / 1024:.0f} KB, read back as {read(file)}")


if __name__ == "__main__":
    main()
