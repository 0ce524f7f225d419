"""report.html, a run in one file that needs no network: scene, tables, pictures; and the pictures beside it."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from itertools import chain
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from shapely import LineString, Point
from shapely.geometry.base import BaseGeometry

from slam.diagnostics.verdict import Verdict, ranges_of
from slam.evaluation import Metric
from slam.files import whole_file
from slam.geometry.frames import lift
from slam.geometry.polygons import largest_polygon, polygons_of, segments_of
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.mapping.consistency import NisSummary
from slam.runs.history import History, in_cm
from slam.runs.stored_run import StoredRun
from slam.visualization.mesh import colour_of, rings_of
from slam.visualization.pictures import FRAME, Drawn, draw_uncertainty, draw_views, without_slits
from slam.visualization.rerun_export import write_rerun
from spplanes._check import FloatArray


def write_report(
    path: Path,
    title: str,
    tables: Sequence[tuple[str, Sequence[Metric]]],
    pictures: Sequence[Path],
    scene: dict[str, Any],
    verdict: Verdict | None = None,
) -> None:
    """Write the page: verdict, map, planes and pictures, charts, and folded below them the tables.

    Everything that comes from files is escaped, pictures (PNG files) and script are embedded. The tables are (caption,
    rows) each; the scene is what `scene_of` makes.
    """
    parts = [_picture(picture) for picture in pictures]
    parts += ['<div id="charts"></div>', *(_table(caption, rows) for caption, rows in tables)]
    page = Template(_asset("page.html")).substitute(
        title=escape(title),
        style=_asset("viewer.css"),
        verdict="" if verdict is None else _verdict(verdict),
        map=_asset("map.html"),
        body="\n".join(parts),
        scene=_in_script(scene),
        script=_asset("viewer.js"),
    )
    path.write_text(page, encoding="utf-8")


def format_value(value: float | int | str) -> str:
    """A value for people: floats to five significant digits, whole numbers whole."""
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _table(caption: str, rows: Sequence[Metric]) -> str:
    lines = ['<tr><th>metric</th><th class="n">value</th><th>unit</th></tr>']
    for row in rows:
        name, value, unit = (escape(text) for text in (row.name, format_value(row.value), row.unit))
        lines.append(f'<tr><td>{name}</td><td class="n">{value}</td><td>{unit}</td></tr>')
    return f"<details><summary>{escape(caption)}</summary>\n<table>{''.join(lines)}</table></details>"


def _verdict(verdict: Verdict) -> str:
    reasons = "".join(f"<br>{escape(reason)}" for reason in verdict.reasons)
    return f'<p class="verdict {verdict.verdict}"><b>The map is {verdict.verdict}.</b>{reasons}</p>'


def _picture(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f'<h2>{escape(path.stem)}</h2>\n<p><img alt="{escape(path.stem)}" src="data:image/png;base64,{data}"></p>'


def _in_script(scene: dict[str, Any]) -> str:
    """JSON in which no name can end the script element or start a comment: < > & are written as escapes."""
    text = json.dumps(scene, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _asset(name: str) -> str:
    return (files("slam.visualization") / "viewer" / name).read_text(encoding="utf-8")


def scene_of(run: Drawn, history: History, doubtful: Sequence[int] = ()) -> dict[str, Any]:
    """Everything the page's script needs, as plain numbers, strings and lists; `doubtful` keyframes as stretches."""
    planes = [_plane(plane) for plane in run.planes if not plane.seen.is_empty]
    estimate, told = _path(run.trajectory), ranges_of(k for k in doubtful if k < len(run.trajectory))
    return {
        "planes": planes,
        "estimate": estimate,
        "odometry": _path(run.odometry),
        "doubtful": [_rounded(run.trajectory.poses[part, :3, 3]) for part in told],
        "points_cm": in_cm(history.points),
        "bounds": _bounds(planes, estimate),
        "keyframes": len(run.trajectory),
        "nis": [_series(kind, history.nis[kind]) for kind in sorted(history.nis) if history.nis[kind]],
    }


def nis_blocks(rows: Sequence[tuple[int, float, int]]) -> list[dict[str, float]]:
    """Mean NIS per degree of freedom of consecutive measurements, with the 95 % band of each block's own size.

    There are at most 60 blocks, of at least 20 measurements each.
    """
    size = max(20, -(-len(rows) // 60))
    count = max(len(rows) // size, 1)
    blocks = []
    for chosen in np.array_split(np.arange(len(rows)), count):
        first, last = rows[chosen[0]][0], rows[chosen[-1]][0]
        nis = NisSummary.of("", [rows[i] for i in chosen])
        blocks.append({"from": first, "to": last, "mean": nis.mean_per_dof, "low": nis.low, "high": nis.high})
    return blocks


def _series(kind: str, rows: Sequence[tuple[int, float, int]]) -> dict[str, Any]:
    rows = sorted(rows, key=lambda row: row[0])
    blocks = nis_blocks(rows)
    inside = sum(block["low"] <= block["mean"] <= block["high"] for block in blocks)
    every = -(-len(rows) // 1500)  # so many dots are drawn at most
    # few measurements make one block: over keyframes it would be one dot, so they are spread one by one
    one_by_one = len(blocks) == 1
    if one_by_one:
        blocks[0].update({"from": 0, "to": max(len(rows) - 1, 1)})
    return {
        "kind": kind,
        "over": "measurement" if one_by_one else "keyframe",
        "last": blocks[-1]["to"] if one_by_one else None,
        "blocks": blocks,
        "dots": [
            [k * every if one_by_one else row[0], round(row[1] / row[2], 3)] for k, row in enumerate(rows[::every])
        ],
        "caption": (
            f"Blue: means of {len(rows) // len(blocks)} measurements each; green: where such a mean lies in 95 % of "
            f"cases when the covariances are honest. {inside} of {len(blocks)} are inside. Dots: single measurements"
            f"{', in the order of their keyframes. ' if one_by_one else '. '}"
            "Above the band the run claims to know more than it does, below it less."
        ),
    }


def _plane(plane: MapPlane) -> dict[str, Any]:
    frame, seen, inside = plane.plane.frame, without_slits(plane.seen), _inside(plane.seen)
    sigmas = np.sqrt(np.diag(plane.plane.covariance))
    return {
        "id": plane.id,
        "normal": plane.plane.normal.tolist(),
        "d": plane.plane.d,
        "sigma_mm": 1e3 * float(sigmas[0]),
        "tilts_deg": np.rad2deg(sigmas[1:]).tolist(),
        "points": int(plane.plane.n_points),
        "observations": plane.observations,
        "kinds": list(plane.kinds),
        "area_m2": float(plane.seen.area),
        "colour": list(colour_of(plane)),
        "faces": [[_rounded(ring[:-1]) for ring in rings_of(part, frame)] for part in polygons_of(seen)],
        "segments": [_rounded(lift(chain, frame)) for chain in segments_of(seen)],
        "inside": _rounded(lift(np.array([[inside.x, inside.y]]), frame))[0],
    }


def _inside(seen: BaseGeometry) -> Point:
    """A point on what was seen: on the largest polygon, else in the middle of the longest line."""
    polygon = largest_polygon(seen)
    if polygon is not None:
        return polygon.representative_point()
    if lines := [LineString(chain) for chain in segments_of(seen)]:
        return max(lines, key=lambda line: line.length).interpolate(0.5, normalized=True)
    return seen.representative_point()


def _path(trajectory: Trajectory) -> list[list[float]]:
    every = -(-len(trajectory) // 5000) or 1
    return _rounded(trajectory.poses[::every, :3, 3])


def _rounded(points: FloatArray) -> list[list[float]]:
    return np.round(points, 4).tolist()  # far below what one sees


def _bounds(planes: Sequence[dict[str, Any]], path: list[list[float]]) -> list[list[float]]:
    rings = chain.from_iterable((*chain.from_iterable(one["faces"]), *one["segments"]) for one in planes)
    points = np.array([*path, *chain.from_iterable(rings)] or [[-1.0] * 3, [1.0] * 3])
    return [points.min(axis=0).tolist(), points.max(axis=0).tolist()]


def view_run(run: Path | str, out: Path | str | None = None, *, recording: Path | None = None) -> list[Path]:
    """Draw plan.png, side.png, uncertainty.png and report.html of a run; returns what was written.

    Without `out` they go into the run's folder and replace older ones; `recording` is a .rrd file for the Rerun viewer.

    Raises:
        ImportError: a recording without the Rerun SDK.
        LogError: no run, or a file of it that is missing or broken.
        ValueError: a place where nothing can be written.
    """
    stored = StoredRun.read(run)
    doubtful = () if stored.verdict is None else stored.verdict.keyframes
    folder = stored.folder if out is None else Path(out)
    *views, uncertainty = drawn = [folder / name for name in ("plan.png", "side.png", "uncertainty.png")]
    for picture in views:
        with whole_file(picture) as scratch:
            draw_views(stored, [picture.stem], FRAME, scratch, doubtful)
    with whole_file(uncertainty) as scratch:
        draw_uncertainty(stored, stored.history, scratch)
    with whole_file(folder / "report.html") as scratch:
        scene = scene_of(stored, stored.history, doubtful)
        title = f"spplanes: {stored.folder.resolve().name}"
        write_report(scratch, title, stored.tables, drawn, scene, stored.verdict)
    if recording is not None:
        with whole_file(recording) as scratch:
            write_rerun(stored, scratch)
    return [*drawn, folder / "report.html", *([] if recording is None else [recording])]
