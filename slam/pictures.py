"""PNG pictures of a run: plan and side view of planes and trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from shapely.geometry.base import BaseGeometry

from slam.frames import lift
from slam.io.trajectories import Trajectory
from slam.mesh import colour_of
from slam.outlines import polygons_of, segments_of
from slam.planeslam import MapPlane
from spplanes._check import FloatArray

#: Planes seen more edge-on than this are drawn as lines, others as faces.
_EDGE_ON_COSINE = 0.5
#: Half the width of slits that pictures do not show, m.
_SLIT_M = 0.05
_VIEWS = {"plan": (0, 1), "side": (0, 2)}


class Drawn(Protocol):
    """What a picture needs of a run."""

    @property
    def planes(self) -> Sequence[MapPlane]:
        """The map."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """The poses."""
        ...

    @property
    def odometry(self) -> Trajectory:
        """Odometry alone, or empty."""
        ...


def without_slits(seen: BaseGeometry) -> BaseGeometry:
    """What was seen of a plane, for the eye: slits between patches seen one after the other are closed."""
    if seen.geom_type not in ("Polygon", "MultiPolygon"):
        return seen
    closed = seen.buffer(_SLIT_M, join_style="mitre").buffer(-_SLIT_M, join_style="mitre").simplify(_SLIT_M / 5.0)
    return closed if not closed.is_empty else seen


def draw_map(run: Drawn, path: Path) -> None:
    """Plan view (x, y), and side view (x, z) where anything has a height, with trajectory and odometry, into a PNG."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    if any(plane.plane.outline is not None for plane in run.planes):
        plan, side = figure.subplots(2, 1, height_ratios=[3, 1], sharex=True)
        draw_view(side, run, "side")
    else:
        plan = figure.subplots()
    draw_view(plan, run, "plan")
    plan.set_title(f"{len(run.planes)} planes, {len(run.trajectory)} poses")
    plan.legend(loc="upper right", fontsize=8)
    save(figure, path)


def draw_view(axes: Any, run: Drawn, view: str) -> None:
    """One view of a run into matplotlib axes: "plan" is (x, y), "side" is (x, z)."""
    horizontal, vertical = _VIEWS[view]
    out_of_sheet = 3 - horizontal - vertical
    for plane in sorted(run.planes, key=lambda plane: abs(plane.plane.normal[out_of_sheet]), reverse=True):
        _draw_plane(axes, plane, (horizontal, vertical), out_of_sheet)
    _draw_path(axes, run.odometry, (horizontal, vertical), "odometry alone", {"color": "tab:red", "ls": "--", "lw": 1})
    _draw_path(axes, run.trajectory, (horizontal, vertical), "estimate", {"color": "black", "lw": 1.5, "marker": "."})
    axes.set_xlabel(f"{'xyz'[horizontal]} [m]")
    axes.set_ylabel(f"{'xyz'[vertical]} [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.autoscale_view()


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG without the clock or the version in it, so that equal runs give equal files."""
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _draw_plane(axes: Any, plane: MapPlane, sheet: tuple[int, int], out_of_sheet: int) -> None:
    colour = np.array(colour_of(plane)) / 255.0
    seen = without_slits(plane.seen)
    rings = [lift(np.asarray(polygon.exterior.coords), plane.plane.frame) for polygon in polygons_of(seen)]
    if abs(plane.plane.normal[out_of_sheet]) > _EDGE_ON_COSINE:
        faces = PolyCollection([ring[:, sheet] for ring in rings], facecolors=[(*colour, 0.15)], edgecolors=[colour])
        faces.set_linewidth(0.4)
        axes.add_collection(faces)
        return
    lines = [lift(segment, plane.plane.frame) for segment in segments_of(seen)]
    edges = [_span(points[:, sheet]) for points in (*rings, *lines)]
    axes.add_collection(LineCollection(edges, colors=[colour], linewidths=2.2))


def _span(points: FloatArray) -> FloatArray:
    """The two ends of points that lie nearly on one line, shape (2, 2)."""
    centred = points - points.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = centred @ direction
    return points.mean(axis=0) + np.outer([along.min(), along.max()], direction)


def _draw_path(
    axes: Any,
    path: Trajectory,
    sheet: tuple[int, int],
    label: str,
    style: dict[str, Any],
) -> None:
    if not len(path):
        return
    places = path.poses[:, :3, 3][:, sheet]
    axes.plot(places[:, 0], places[:, 1], label=label, markersize=3, **style)


mpl.rcParams["svg.hashsalt"] = "spplanes"
