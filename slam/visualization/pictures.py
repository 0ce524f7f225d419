"""PNG pictures of a run: plan and side view of planes and trajectory, and how sure the map is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.path import Path as Outline
from scipy.special import gammaincinv
from shapely.geometry.base import BaseGeometry

from slam.geometry.frames import lift
from slam.geometry.polygons import polygons_of, segments_of
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.runs.history import History
from slam.visualization.mesh import colour_of, rings_of
from spplanes._check import FloatArray

#: Width of strokes that stand for a plane, points.
_STRONG = 2.2
#: Half the width of slits that pictures do not show, m.
_SLIT_M = 0.05
_VIEWS = {"plan": (0, 1), "side": (0, 2)}
#: Width of a picture, inches.
WIDTH = 11.0
#: What its title and axes take beside one view, inches.
FRAME = 1.2

Colours = Callable[[MapPlane], FloatArray]


class Drawn(Protocol):
    """What a picture needs of a run."""

    @property
    def planes(self) -> Sequence[MapPlane]:
        """The map."""

    @property
    def trajectory(self) -> Trajectory:
        """The poses."""

    @property
    def odometry(self) -> Trajectory:
        """Odometry alone, or empty."""


def draw_map(run: Drawn, path: Path, doubtful: Sequence[int] = ()) -> None:
    """Plan view (x, y), and side view (x, z) where anything has a height, with trajectory and odometry, into a PNG.

    Keyframes that are `doubtful` are marked on the trajectory.
    """
    views = ["plan", "side"] if any(plane.plane.outline is not None for plane in run.planes) else ["plan"]
    draw_views(run, views, 0.7 * len(views) + 0.3, path, doubtful)


def draw_views(run: Drawn, views: Sequence[str], frame: float, path: Path, doubtful: Sequence[int]) -> None:
    """Views, "plan" or "side", one below the other, and so many inches beside them, as `draw_map`."""
    heights = [view_height(run, view) for view in views]
    figure = Figure(figsize=(WIDTH, sum(heights) + frame), layout="constrained")
    axes = figure.subplots(len(views), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axis, view in zip(axes, views, strict=True):
        draw_view(axis, run, view)
        if marked := [keyframe for keyframe in doubtful if keyframe < len(run.trajectory)]:
            places = run.trajectory.poses[marked, :3, 3][:, _VIEWS[view]]
            style = {"ls": "", "marker": "o", "markersize": 6, "alpha": 0.8, "zorder": 4}
            axis.plot(*places.T, label="doubtful", color="tab:orange", **style)
    axes[0].set_title(title_of(run))
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="upper right", fontsize=8)
    save(figure, path)


def draw_view(axes: Any, run: Drawn, view: str, colours: Colours | None = None, *, with_odometry: bool = True) -> None:
    """One view of a run into matplotlib axes: planes as `draw_planes` has them, and the ways."""
    draw_planes(axes, run.planes, view, colours)
    if with_odometry:
        _draw_way(axes, run.odometry, view, label="odometry alone", color="tab:red", ls="--", lw=1)
    _draw_way(axes, run.trajectory, view, label="trajectory", color="black", lw=1.5, marker=".")
    axes.autoscale_view()


def _draw_way(axes: Any, way: Trajectory, view: str, **style: Any) -> None:
    if len(way):
        axes.plot(*way.poses[:, :3, 3][:, _VIEWS[view]].T, markersize=3, **style)


def draw_planes(axes: Any, planes: Sequence[MapPlane], view: str, colours: Colours | None = None) -> None:
    """Planes into matplotlib axes: "plan" is (x, y), "side" is (x, z); coloured by direction or as told."""
    sheet = _VIEWS[view]
    out_of_sheet = 3 - sum(sheet)
    for plane in sorted(planes, key=lambda plane: abs(plane.plane.normal[out_of_sheet]), reverse=True):
        colour = np.array(colour_of(plane)) / 255.0 if colours is None else colours(plane)
        _draw_plane(axes, plane, sheet, out_of_sheet, colour)
    axes.set_xlabel(f"{'xyz'[sheet[0]]} [m]")
    axes.set_ylabel(f"{'xyz'[sheet[1]]} [m]")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.autoscale_view()


def view_height(run: Drawn, view: str) -> float:
    """Height in inches that a view of the usual width needs."""
    sheet = list(_VIEWS[view])
    parts = [lift(shapely.get_coordinates(plane.seen), plane.plane.frame) for plane in run.planes]
    points = np.concatenate([run.trajectory.poses[:, :3, 3], *parts, np.zeros((1, 3))])[:, sheet]
    wide, tall = np.ptp(points, axis=0)
    return float(np.clip(WIDTH * tall / max(wide, 1e-9), 1.8, 9.0))


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
    # what is seen edge-on is as thin as the stroke round it
    width = 0.5 if abs(plane.plane.normal[out_of_sheet]) > 0.1 else _STRONG
    rings = [[Outline(ring[:, sheet], closed=True) for ring in rings_of(polygon, frame)] for polygon in polygons]
    outlines = [Outline.make_compound_path(*around) for around in rings]  # holes run the other way round
    axes.add_collection(PathCollection(outlines, facecolors=[(*colour, 0.2)], edgecolors=[colour], linewidths=width))
    edges = [lift(chain, frame)[:, sheet] for chain in segments_of(seen)]
    axes.add_collection(LineCollection(edges, colors=[colour], linewidths=_STRONG))


mpl.rcParams["svg.hashsalt"] = "spplanes"


#: Probability inside an ellipse.
CONFIDENCE = 0.95


def draw_uncertainty(run: Drawn, history: History, path: Path) -> None:
    """Plan view into a PNG: planes by the standard deviation along their normal, ellipses of 95 % at the poses.

    Ellipses too small to see are enlarged by a power of ten, which the title states.
    """
    figure = Figure(figsize=(WIDTH, view_height(run, "plan") + FRAME), layout="constrained")
    axes = figure.subplots()
    sigmas = [_sigma_mm(plane) for plane in run.planes]  # the scale ends where 95 % of the planes stay below
    scale = Normalize(0.0, float(np.quantile(sigmas, 0.95)) if max(sigmas, default=0.0) > 0.0 else 1.0)
    colours = colormaps["viridis"]

    def by_sigma(plane: MapPlane) -> FloatArray:
        return np.array(colours(scale(_sigma_mm(plane)))[:3])

    draw_view(axes, run, "plan", by_sigma, with_odometry=False)
    note = _draw_ellipses(axes, run, history)
    axes.set_title(title_of(run) + note)
    bar = figure.colorbar(ScalarMappable(scale, colours), ax=axes, shrink=0.7, extend="max")
    bar.set_label("σ along the normal [mm]")
    save(figure, path)


def position_covariances(run: Drawn, history: History) -> tuple[FloatArray, FloatArray]:
    """Positions (K, 3) of the poses whose covariance is known, and the covariance (K, 3, 3) of each, in the world."""
    chosen = [keyframe for keyframe in sorted(history.pose_covariances) if keyframe < len(run.trajectory)]
    poses = run.trajectory.poses[chosen].reshape(-1, 4, 4)
    own = np.array([history.pose_covariances[keyframe][:3, :3] for keyframe in chosen]).reshape(-1, 3, 3)
    rotations = poses[:, :3, :3]
    return poses[:, :3, 3], rotations @ own @ rotations.transpose(0, 2, 1)


def _draw_ellipses(axes: Any, run: Drawn, history: History) -> str:
    """Put the ellipses in; what the title says about them."""
    places, covariances = position_covariances(run, history)
    if not len(places):
        return ""
    values, vectors = np.linalg.eigh(covariances[:, :2, :2])
    diameters = 2.0 * np.sqrt(np.maximum(values, 0.0) * 2.0 * gammaincinv(0.5 * 2, CONFIDENCE))
    largest = float(diameters.max())
    width = float(np.ptp(axes.get_xlim()))
    # the largest should be some 4 % of the picture's width
    factor = 10.0 ** max(np.floor(np.log10(0.04 * width / largest)), 0.0) if largest > 0.0 else 1.0
    angles = np.rad2deg(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    sizes = factor * diameters[:, 1], factor * diameters[:, 0], angles
    at: dict[str, Any] = {"units": "xy", "offsets": places[:, :2], "transOffset": axes.transData}
    look: dict[str, Any] = {"facecolors": [(0.2, 0.4, 0.9, 0.15)], "edgecolors": ["tab:blue"], "linewidths": 0.8}
    axes.add_collection(EllipseCollection(*sizes, zorder=3, **at, **look))
    enlarged = "" if factor == 1.0 else f", enlarged {factor:.0f} times"
    return f"; ellipses: {CONFIDENCE:.0%} of positions{enlarged}"


def _sigma_mm(plane: MapPlane) -> float:
    return 1e3 * float(np.sqrt(plane.plane.covariance[0, 0]))
