"""The planes of one cloud as files: planes.json, meshes, coloured points, a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from slam.io.clouds.ply import write_ply_tables
from slam.io.planes_json import write_planes
from slam.output.run_files import ply_points, write_ply
from slam.runs.cloud_fit import FittedCloud
from slam.visualization.mesh import colour_of, mesh_of
from slam.visualization.pictures import draw_planes, save

#: Points without a plane that a picture shows at most.
_DRAWN_POINTS = 20000


def write_cloud_planes(found: FittedCloud, folder: Path) -> None:
    """planes.json, planes.ply (outlines as triangles), points.ply (the returns with their plane) and planes.png."""
    write_planes(folder / "planes.json", found.map_planes)
    write_ply(folder / "planes.ply", mesh_of(found.map_planes))
    colours = np.array([*(colour_of(plane) for plane in found.map_planes), (40, 40, 40)], dtype=np.uint8)
    points = ply_points(found.points, colours[found.labels], found.labels)
    write_ply_tables(folder / "points.ply", {"vertex": points})
    _draw_cloud(found, folder / "planes.png")


def _draw_cloud(found: FittedCloud, path: Path) -> None:
    """Plan and side view of the planes over the points that belong to none."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    plan, side = figure.subplots(2, 1, height_ratios=[3, 1], sharex=True)
    rest = found.points[found.labels < 0]
    rest = rest[:: max(len(rest) // _DRAWN_POINTS, 1)]
    for axes, view, upright in ((plan, "plan", 1), (side, "side", 2)):
        axes.plot(rest[:, 0], rest[:, upright], ",", color="0.6")
        draw_planes(axes, found.map_planes, view)
        axes.plot(found.viewpoint[0], found.viewpoint[upright], "k+")
    plan.set_title(f"{len(found.planes)} planes")
    save(figure, path)
