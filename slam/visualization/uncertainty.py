"""How sure a map is, as a picture: planes by their standard deviation, positions as confidence ellipses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.special import gammaincinv

from slam.map.map_planes import MapPlane
from slam.runs.history import History
from slam.visualization.pictures import Drawn, draw_view, save, title_of, view_height
from spplanes._check import FloatArray

#: Probability inside an ellipse.
CONFIDENCE = 0.95
#: The largest ellipse should be this share of the picture's width.
_LARGEST_SHARE = 0.04


def draw_uncertainty(run: Drawn, history: History, path: Path) -> None:
    """Plan view into a PNG: planes by the standard deviation along their normal, ellipses of 95 % at the poses.

    Ellipses too small to see are enlarged by a power of ten, which the title states.
    """
    figure = Figure(figsize=(11.0, view_height(run, "plan") + 1.2), layout="constrained")
    axes = figure.subplots()
    scale = Normalize(0.0, _upper([_sigma_mm(plane) for plane in run.planes]))
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
    factor = 10.0 ** max(np.floor(np.log10(_LARGEST_SHARE * width / largest)), 0.0) if largest > 0.0 else 1.0
    angles = np.rad2deg(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    ellipses = EllipseCollection(
        factor * diameters[:, 1],
        factor * diameters[:, 0],
        angles,
        units="xy",
        offsets=places[:, :2],
        transOffset=axes.transData,
        facecolors=[(0.2, 0.4, 0.9, 0.15)],
        edgecolors=["tab:blue"],
        linewidths=0.8,
        zorder=3,
    )
    axes.add_collection(ellipses)
    enlarged = "" if factor == 1.0 else f", enlarged {factor:.0f} times"
    return f"; ellipses: {CONFIDENCE:.0%} of positions{enlarged}"


def _sigma_mm(plane: MapPlane) -> float:
    return 1e3 * float(np.sqrt(plane.plane.covariance[0, 0]))


def _upper(sigmas: list[float]) -> float:
    """Where the scale of colours ends: what 95 % of the planes stay below."""
    return float(np.quantile(sigmas, 0.95)) if sigmas and max(sigmas) > 0.0 else 1.0
