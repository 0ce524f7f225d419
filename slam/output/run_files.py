"""The files of a run, and of one cloud: configuration, trajectory, planes, mesh, numbers and pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from slam.config import SlamConfig
from slam.errors import LogError
from slam.evaluation import Metric
from slam.files import whole_file
from slam.frontend.measurement import returns_of
from slam.geometry.frames import evenly, lift
from slam.io.clouds.ply import write_ply_tables
from slam.io.g2o.writer import write_g2o
from slam.io.planes_json import write_planes
from slam.io.raw import damage_told, read_bytes
from slam.io.trajectories import Trajectory, write_tum
from slam.output.run_metrics import details_of, map_metrics_of, metrics_of, timings_of
from slam.runs.cloud_fit import FittedCloud
from slam.runs.graph_import import ImportedRun
from slam.runs.history import History
from slam.runs.mapping_run import MapResult
from slam.runs.slam_run import Run
from slam.sensors.log import CloudScan, Log
from slam.sensors.rig import Rig
from slam.tracking.turns import sweeps_of
from slam.visualization.mesh import Mesh, colour_of, mesh_of
from slam.visualization.pictures import Drawn, draw_map, draw_planes, draw_uncertainty, save
from slam.visualization.report import scene_of, write_report
from spplanes._check import FloatArray


def write_run(run: Run, folder: Path, *, title: str, extra: Sequence[tuple[str, Sequence[Metric]]] = ()) -> None:
    """Write everything about a run into a folder that exists; `extra` tables go into the numbers and the page."""
    rows = metrics_of(run) + timings_of(run.clock.seconds)
    numbers = {"metrics": as_json(rows), **details_of(run), **{caption: as_json(table) for caption, table in extra}}
    write_result(run, folder, run.slam.config, run.rig, numbers, run.verdict.keyframes)
    write_tum(folder / "scans.tum", run.scan_trajectory)
    if len(run.scan_odometry):
        write_tum(folder / "odometry.tum", run.scan_odometry)
    write_g2o(folder / "graph.g2o", run.slam.backend.graph, run.slam.backend.values)
    history = History.of(run.planes, run.slam, points_of_map(run.log, run.rig, run.scan_trajectory))
    history.write(folder / "view.json")
    draw_uncertainty(run, history, folder / "uncertainty.png")
    pictures = [folder / "map.png", folder / "uncertainty.png"]
    tables, scene = [*extra, ("the run", rows)], scene_of(run, history, run.verdict.keyframes)
    write_report(folder / "report.html", title, tables, pictures, scene, run.verdict)


def write_map(
    result: MapResult, folder: Path, config: SlamConfig, rig: Rig, *, title: str, log: Log | None = None
) -> list[Metric]:
    """Write a map made at given poses into a folder that exists; returns the table, times left out.

    With the `log` that it was made from, some of its points are shown on the page.
    """
    table = map_metrics_of(result)
    rows = table + timings_of(result.clock.seconds)
    write_result(result, folder, config, rig, {"metrics": as_json(rows)})
    write_tum(folder / "scans.tum", result.scan_trajectory)
    points = None if log is None else points_of_map(log, rig, result.scan_trajectory)
    history = History.of(result.planes, points=points)
    history.write(folder / "view.json")
    write_report(folder / "report.html", title, [("the map", rows)], [folder / "map.png"], scene_of(result, history))
    return table


def write_import(imported: ImportedRun, folder: Path, run: Path) -> None:
    """Write a run whose graph came back from another tool into a folder that exists."""
    config, rig = SlamConfig.from_yaml(run / "config.yaml"), Rig.from_yaml(run / "rig.yaml")
    write_result(imported, folder, config, rig, {"metrics": as_json(imported.table)})
    if len(imported.odometry):
        write_tum(folder / "odometry.tum", imported.odometry)
    (folder / "graph.g2o").write_text(imported.graph, encoding="utf-8")
    History.of(imported.planes).write(folder / "view.json")


def write_result(
    drawn: Drawn, folder: Path, config: SlamConfig, rig: Rig, numbers: dict[str, Any], doubtful: Sequence[int] = ()
) -> None:
    """What every run leaves: how it was made, where it went, what it saw, in numbers and as a picture."""
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
    rig.to_yaml(folder / "rig.yaml")
    write_tum(folder / "trajectory.tum", drawn.trajectory)
    write_planes(folder / "planes.json", drawn.planes)
    write_ply(folder / "map.ply", mesh_of(drawn.planes))
    write_json(folder / "metrics.json", numbers)
    draw_map(drawn, folder / "map.png", doubtful)


def add_to_metrics(folder: Path, key: str, rows: Sequence[Metric]) -> None:
    """Put a table into the metrics.json of a run, beside what is there; ValueError: that cannot be read or written."""
    path = folder / "metrics.json"
    with whole_file(path) as scratch, damage_told(path, "expected the metrics.json of a run, got something else"):
        write_json(scratch, {**json.loads(read_bytes(path)), key: as_json(rows)})


def as_json(rows: Sequence[Metric]) -> list[dict[str, Any]]:
    """Rows of a table as JSON; what could not be measured, NaN, becomes null."""
    return [{"metric": name, "value": value if value == value else None, "unit": unit} for name, value, unit in rows]


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary PLY with a colour per corner and the landmark id of its plane."""
    faces = np.empty(len(mesh.triangles), dtype=[("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = mesh.triangles
    write_ply_tables(path, {"vertex": ply_points(mesh.vertices, mesh.colours, mesh.plane_ids), "face": faces})


def ply_points(points: FloatArray, colours: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """The table of a PLY of points (N, 3), m, their RGB (N, 3) in 0..255, and the id of the plane (N,) of each."""
    fields = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("plane", "i4")]
    return np.rec.fromarrays([*points.T, *colours.T, planes], dtype=fields)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Strict JSON: NaN is refused rather than written as a word no other reader knows."""
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")


#: Points that are kept: a page of some 150 kB more, drawn in some 10 ms.
MOST_POINTS = 15_000
#: Scans that they come from, evenly over the run: 3D scans are read from their files again.
_MOST_CLOUDS, _MOST_SCANS = 24, 400


def points_of_map(log: Log, rig: Rig, scans: Trajectory) -> FloatArray:
    """Returns of scans at their poses, shape (N, 3), m, N at most `MOST_POINTS`; the same ones each time.

    `scans` are world_T_body at the scans, by what they are stamped. Left out are scans of sensors that the rig does not
    have, and of files that cannot be read.
    """
    known = [one for one in log.scans() if one.sensor in rig.sensors]
    stamps = log.as_stamped([one.stamp_ns for one in known]).tolist()
    poses = dict(zip(scans.stamps_ns.tolist(), scans.poses, strict=True))
    posed = [(one, poses[stamp]) for one, stamp in zip(known, stamps, strict=True) if stamp in poses]
    most = _MOST_CLOUDS if any(isinstance(one, CloudScan) for one, _ in posed) else _MOST_SCANS
    chosen = [posed[k] for k in evenly(len(posed), most)]
    sweeps = sweeps_of(scans, rig.sensors.values())
    parts = [np.empty((0, 3))]
    for scan, pose in chosen:
        sensor = rig.sensors[scan.sensor]
        with suppress(LogError):
            seen = returns_of(scan, sensor, sweeps)
            kept = seen[evenly(len(seen), MOST_POINTS // len(chosen))]
            parts.append(lift(kept, pose @ sensor.body_T_sensor))
    return np.concatenate(parts)


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
    rest = rest[:: max(len(rest) // 20_000, 1)]  # about so many, however many there are
    for axes, view, upright in ((plan, "plan", 1), (side, "side", 2)):
        axes.plot(rest[:, 0], rest[:, upright], ",", color="0.6")
        draw_planes(axes, found.map_planes, view)
        axes.plot(found.viewpoint[0], found.viewpoint[upright], "k+")
    plan.set_title(f"{len(found.planes)} planes")
    save(figure, path)
