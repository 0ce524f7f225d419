"""Draw the figures of docs/conventions.md: `python tools/convention_figures.py`."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial.transform import Rotation

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "img"
COLOURS = {"x": "#c53030", "y": "#2f855a", "z": "#2b6cb0"}


def main() -> None:
    """Write docs/img/convention_*.png."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    draw_plane(IMAGES / "convention_plane.png")
    draw_perturbations(IMAGES / "convention_perturbations.png")
    draw_line(IMAGES / "convention_line.png")


def draw_plane(path: Path) -> None:
    """The plane frame: origin, axes, normal toward the sensor, d."""
    figure, (axes,) = scene(1, (5.2, 3.9))
    frame = np.column_stack(([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    centre = np.array([-2.0, 0.4, 0.9])
    patch(axes, centre, frame, (1.3, 0.7))
    triad(axes, centre, frame, 0.75, ("x (longer)", "y", "z = normal"))
    triad(axes, np.zeros(3), np.eye(3), 0.6, ("", "", ""))
    axes.text(0.1, 0.0, -0.32, "sensor", ha="center")
    axes.plot(*np.array([[0, 0, 0], [-2.0, 0, 0]]).T, color="black", ls=":", lw=1.2)
    axes.text(-1.0, 0.0, 0.08, "d < 0: normal · x = d")
    limits(axes, (-2.4, 0.8), (-1.3, 1.9), (-0.4, 1.8))
    axes.view_init(22, -58)
    save(figure, path)


def draw_perturbations(path: Path) -> None:
    """What z, theta and psi do, each positive."""
    figure, panels = scene(3, (9.6, 3.3))
    names = (
        "z: shift along the normal",
        "theta: turn about y\nz(x, y) = − theta x",
        "psi: turn about x\nz(x, y) = psi y",
    )
    turns = (np.eye(3), *(Rotation.from_euler(axis, 0.35).as_matrix() for axis in "yx"))
    for axes, name, turn, shift in zip(panels, names, turns, (0.55, 0.0, 0.0), strict=True):
        patch(axes, np.zeros(3), np.eye(3), (1.2, 0.8), alpha=0.25)
        patch(axes, np.array([0.0, 0.0, shift]), turn, (1.2, 0.8), colour="#dd8452")
        triad(axes, np.zeros(3), np.eye(3), 0.9, ("x", "y", "z"))
        axes.set_title(name, fontsize=9, y=0.97)
        limits(axes, (-1.3, 1.3), (-1.0, 1.0), (-0.6, 1.0))
        axes.view_init(22, -60)
    save(figure, path)


def draw_line(path: Path) -> None:
    """A line of a 2D laser: alpha, rho and its normal away from the sensor."""
    figure = Figure(figsize=(4.6, 3.4), layout="constrained")
    axes = figure.subplots()
    alpha, rho = np.radians(35.0), 2.0
    normal, along = np.array([np.cos(alpha), np.sin(alpha)]), np.array([-np.sin(alpha), np.cos(alpha)])
    ends = rho * normal + np.outer([-1.2, 1.6], along)
    axes.plot(*ends.T, color="#4c72b0", lw=3)
    arrow = {"arrowstyle": "-|>", "lw": 1.6}
    axes.annotate("", 1.0 * rho * normal, (0, 0), arrowprops={**arrow, "color": COLOURS["z"]})
    axes.annotate("", (0.9, 0), (0, 0), arrowprops={**arrow, "color": COLOURS["x"]})
    axes.annotate("", (0, 0.9), (0, 0), arrowprops={**arrow, "color": COLOURS["y"]})
    arc = np.linspace(0.0, alpha, 30)
    axes.plot(0.6 * np.cos(arc), 0.6 * np.sin(arc), color="black", lw=1)
    axes.text(0.66, 0.14, "alpha")
    axes.text(*(0.62 * rho * normal + [-0.28, 0.12]), "rho")
    axes.text(0.95, -0.06, "x forward", va="top", ha="center", color=COLOURS["x"])
    axes.text(-0.08, 0.95, "y left", ha="right", color=COLOURS["y"])
    axes.plot(0, 0, "ko", ms=5)
    axes.text(-0.1, -0.1, "sensor", ha="right", va="top")
    axes.set_aspect("equal")
    axes.set_axis_off()
    save(figure, path)


def scene(count: int, size: tuple[float, float]) -> tuple[Figure, list[Any]]:
    """A figure with so many empty 3D scenes side by side."""
    figure = Figure(figsize=size)
    panels = [figure.add_subplot(1, count, i + 1, projection="3d") for i in range(count)]
    for axes in panels:
        axes.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 1, 0, 0)
    return figure, panels


def patch(axes: Any, centre: np.ndarray, frame: np.ndarray, half: tuple[float, float], **style: Any) -> None:
    """A rectangle in the x and y of a frame."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
    colour = style.get("colour", "#4c72b0")
    face = Poly3DCollection([corners @ frame.T + centre], facecolor=colour, edgecolor="#333333")
    face.set_alpha(style.get("alpha", 0.45))
    axes.add_collection3d(face)


def triad(axes: Any, origin: np.ndarray, frame: np.ndarray, length: float, names: tuple[str, str, str]) -> None:
    """The axes of a frame, x, y, z."""
    for direction, name, colour in zip(frame.T, names, COLOURS.values(), strict=True):
        axes.quiver(*origin, *(length * direction), color=colour, lw=2, arrow_length_ratio=0.18)
        axes.text(*(origin + 1.12 * length * direction), name, color=colour, fontsize=9)


def limits(axes: Any, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
    """What is shown, at equal scales."""
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.set_zlim(*z)
    axes.set_box_aspect([x[1] - x[0], y[1] - y[0], z[1] - z[0]], zoom=1.05)


def save(figure: Figure, path: Path) -> None:
    """A small PNG, the same every time."""
    figure.savefig(path, dpi=90, metadata={"Software": None})


if __name__ == "__main__":
    main()
