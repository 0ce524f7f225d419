"""Make the figures of the README: `python tools/figures.py [FOLDER_OF_REAL_DATA]`.

The simulated ones always; those of real data where they are: the loop, and corridor and hall as their pages show them.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

from slam.config import SlamConfig
from slam.io.load import load
from slam.output.new_folder import new_folder
from slam.output.run_files import write_run
from slam.runs.slam_run import Run, run_slam
from slam.simulation import simulate_mission
from slam.visualization.pictures import draw_view, title_of, view_height

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "img"
#: Width of a figure, inches, and of pictures.draw_map, to which view_height refers.
WIDTH, USUAL_WIDTH = 8.0, 11.0


def main(data: Path) -> None:
    """Write the pictures of docs/gallery.md into docs/img."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    mission = simulate_mission("corridor", n_scans=400, seed=0)
    picture(run_slam(mission.log, mission.rig, SlamConfig()), IMAGES / "demo.png", "simulated push-broom mission")
    office = simulate_mission("office", seed=0)
    plan(run_slam(office.log, office.rig, SlamConfig()), IMAGES / "office.png", "a simulated office")
    loop = data / "loop5" / "loop5.clf.gz"
    if loop.is_file():
        log, rig = load(loop)
        run, title = run_slam(log, rig, SlamConfig()), "a corridor loop seen by one 2D laser"
        plan(run, IMAGES / "loop.png", title)
        page(run, IMAGES / "points.png", title, part="#points")
    corridor = data / "3dtk_corridor"
    if corridor.is_dir():
        log, rig = load(corridor)
        run = run_slam(log, rig, SlamConfig())
        page(run, IMAGES / "corridor.png", "a real corridor: three scans of a tilting laser")
    hall = data / "balm_hall"
    if hall.is_dir():
        log, rig = load(hall)
        page(
            run_slam(log, rig, SlamConfig()),
            IMAGES / "hall.png",
            "a real hall: 20 clouds of a spinning lidar, no odometry",
        )


def picture(run: Run, path: Path, title: str) -> None:
    """Plan and side view, small enough for a README."""
    heights = [view_height(run, view) * WIDTH / USUAL_WIDTH for view in ("plan", "side")]
    figure = Figure(figsize=(WIDTH, sum(heights) + 1.6), layout="constrained")
    plan, side = figure.subplots(2, 1, height_ratios=heights)
    draw_view(plan, run, "plan")
    draw_view(side, run, "side")
    plan.set_title(f"{title}: {title_of(run)}", fontsize=10)
    plan.legend(loc="upper right", fontsize=7)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def plan(run: Run, path: Path, title: str) -> None:
    """Plan view alone."""
    figure = Figure(figsize=(WIDTH, view_height(run, "plan") * WIDTH / USUAL_WIDTH + 0.6), layout="constrained")
    axes = figure.subplots()
    draw_view(axes, run, "plan")
    axes.set_title(f"{title}: {title_of(run)}", fontsize=10)
    axes.legend(loc="lower left", fontsize=7)
    figure.savefig(path, dpi=70, metadata={"Software": None})


def page(run: Run, path: Path, title: str, part: str = "") -> None:
    """The page of a run, or a `part` of it, as a browser shows it; nothing without one."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print(f"no Chromium here: docs/img/{path.name} stays as it is")
        return
    with tempfile.TemporaryDirectory() as scratch:
        with new_folder(Path(scratch) / "run") as folder:
            write_run(run, folder, title=title)
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1100,645"]
        address = (Path(scratch) / "run" / "report.html").as_uri() + part
        profile = f"--user-data-dir={scratch}/profile"
        command = [browser, *flags, profile, f"--screenshot={path}", address]
        subprocess.run(command, check=True, capture_output=True, timeout=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT.parent / "shared" / "data")
