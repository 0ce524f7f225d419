"""PNG pictures of a run: plan and side view of planes and trajectory, and how sure the map is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline
from shapely.geometry.base import BaseGeometry

from slam.geometry.frames import lift
from slam.geometry.polygons import polygons_of, segments_of
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.visualization.mesh import colour_of
from spplanes._check import FloatArray

#: Planes seen more edge-on than this (cosine) are as thin as the stroke round them, which is then a strong one.
_EDGE_ON_COSINE = 0.1
_THIN, _STRONG = 0.5, 2.2
#: Half the width of slits that pictures do not show, m.
_SLIT_M = 0.05
_VIEWS = {"plan": (0, 1), "side": (0, 2)}
#: Width of a picture, and least and greatest height of one view in it, inches.
_WIDTH, _LOW, _HIGH = 11.0, 1.8, 9.0

Colours = Callable[[MapPlane], FloatArray]


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


def draw_map(run: Drawn, path: Path, doubtful: Sequence[int] = ()) -> None:
    """Plan view (x, y), and side view (x, z) where anything has a height, with trajectory and odometry, into a PNG.

    Keyframes that are `doubtful` are marked on the trajectory.
    """
    views = ["plan", "side"] if any(plane.plane.outline is not None for plane in run.planes) else ["plan"]
    heights = [view_height(run, view) for view in views]
    figure = Figure(figsize=(_WIDTH, sum(heights) + 0.7 * len(views) + 0.3), layout="constrained")
    axes = figure.subplots(len(views), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axis, view in zip(axes, views, strict=True):
        draw_view(axis, run, view)
        mark(axis, run.trajectory, view, doubtful)
    axes[0].set_title(title_of(run))
    _legend(axes[0])
    save(figure, path)


def draw_one(run: Drawn, view: str, path: Path, doubtful: Sequence[int] = ()) -> None:
    """One view, "plan" or "side", into a PNG of its own, keyframes that are `doubtful` marked."""
    figure = Figure(figsize=(_WIDTH, view_height(run, view) + 1.2), layout="constrained")
    axes = figure.subplots()
    draw_view(axes, run, view)
    mark(axes, run.trajectory, view, doubtful)
    axes.set_title(title_of(run))
    _legend(axes)
    save(figure, path)


def draw_view(axes: Any, run: Drawn, view: str, colours: Colours | None = None, *, with_odometry: bool = True) -> None:
    """One view of a run into matplotlib axes: "plan" is (x, y), "side" is (x, z); planes by direction or as told."""
    sheet = _VIEWS[view]
    out_of_sheet = 3 - sum(sheet)
    for plane in sorted(run.planes, key=lambda plane: abs(plane.plane.normal[out_of_sheet]), reverse=True):
        colour = np.array(colour_of(plane)) / 255.0 if colours is None else colours(plane)
        _draw_plane(axes, plane, sheet, out_of_sheet, colour)
    if with_odometry:
        _draw_path(axes, run.odometry, sheet, "odometry alone", {"color": "tab:red", "ls": "--", "lw": 1})
    _draw_path(axes, run.trajectory, sheet, "trajectory", {"color": "black", "lw": 1.5, "marker": "."})
    axes.set_xlabel(f"{'xyz'[sheet[0]]} [m]")
    axes.set_ylabel(f"{'xyz'[sheet[1]]} [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.autoscale_view()


def mark(axes: Any, path: Trajectory, view: str, keyframes: Sequence[int]) -> None:
    """Colour keyframes of a trajectory on one of its views."""
    chosen = [keyframe for keyframe in keyframes if keyframe < len(path)]
    if not chosen:
        return
    places = path.poses[chosen, :3, 3][:, _VIEWS[view]]
    axes.plot(*places.T, label="doubtful", color="tab:orange", ls="", marker="o", markersize=6, alpha=0.8, zorder=4)


def view_height(run: Drawn, view: str) -> float:
    """Height in inches that a view of the usual width needs."""
    sheet = list(_VIEWS[view])
    parts = [lift(shapely.get_coordinates(plane.seen), plane.plane.frame) for plane in run.planes]
    points = np.concatenate([run.trajectory.poses[:, :3, 3], *parts, np.zeros((1, 3))])[:, sheet]
    wide, tall = np.ptp(points, axis=0)
    return float(np.clip(_WIDTH * tall / max(wide, 1e-9), _LOW, _HIGH))


def title_of(run: Drawn) -> str:
    """How much there is."""
    return f"{len(run.planes)} planes, {len(run.trajectory)} poses"


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG without the clock or the version in it, so that equal runs give equal files."""
    figure.savefig(path, format="png", dpi=110, metadata={"Software": None})


def without_slits(seen: BaseGeometry) -> BaseGeometry:
    """What was seen of a plane, for the eye: slits between patches seen one after the other are closed."""
    polygons = shapely.union_all(polygons_of(seen))
    if polygons.is_empty:
        return seen
    joined = polygons.buffer(_SLIT_M, join_style="mitre").buffer(-_SLIT_M, join_style="mitre")
    lines = [shapely.LineString(chain) for chain in segments_of(seen)]
    return shapely.GeometryCollection([joined.simplify(_SLIT_M / 5.0), *lines])


def _draw_plane(axes: Any, plane: MapPlane, sheet: tuple[int, int], out_of_sheet: int, colour: FloatArray) -> None:
    seen, frame = without_slits(plane.seen), plane.plane.frame
    polygons = [shapely.orient_polygons(polygon) for polygon in polygons_of(seen)]
    width = _THIN if abs(plane.plane.normal[out_of_sheet]) > _EDGE_ON_COSINE else _STRONG
    outlines = [_outline(polygon, frame, sheet) for polygon in polygons]
    axes.add_collection(PathCollection(outlines, facecolors=[(*colour, 0.2)], edgecolors=[colour], linewidths=width))
    edges = [lift(chain, frame)[:, sheet] for chain in segments_of(seen)]
    axes.add_collection(LineCollection(edges, colors=[colour], linewidths=_STRONG))


def _outline(polygon: shapely.Polygon, frame: FloatArray, sheet: tuple[int, int]) -> Outline:
    """A polygon with its holes, which run the other way round, on the sheet."""
    rings = [lift(shapely.get_coordinates(ring), frame)[:, sheet] for ring in (polygon.exterior, *polygon.interiors)]
    return Outline.make_compound_path(*[Outline(ring, closed=True) for ring in rings])


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


def _legend(axes: Any) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", fontsize=8)


mpl.rcParams["svg.hashsalt"] = "spplanes"
