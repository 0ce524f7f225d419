"""Make the figures of the README: `python tools/figures.py [FOLDER_OF_REAL_DATA]`.

The simulated ones always, the floor plan by a browser; those of real data where they are: the loop, and corridor and
hall as their pages in a browser show them.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.corpus.drives import Recipe, make_drive
from benchmarks.corpus.suite import Suite
from slam.config import SlamConfig
from slam.files import new_folder
from slam.floorplan import floor_plan, joint_planes
from slam.io.load import load
from slam.joining import FinishedMission, join
from slam.output.joined_folder import draw_missions
from slam.output.plan_drawing import write_svg
from slam.output.run_files import write_run
from slam.runs.slam_run import Run, run_slam
from slam.simulation import simulate_mission
from slam.simulation.record import Plan, record
from slam.simulation.robots import spinning_rig
from slam.visualization.pictures import draw_view, title_of, view_height

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "img"
#: Way between two scans in the office, m.
SPACING = 0.6
#: Which part of an office each robot of a fleet drives through, and whether from the end.
VISITS = ((0.0, 0.4, False), (0.2, 0.6, True), (0.4, 0.8, False), (0.6, 1.0, True))
#: Width of a figure, inches, and of pictures.draw_map, to which view_height refers.
WIDTH, USUAL_WIDTH = 8.0, 11.0


def main(data: Path) -> None:
    """Write the pictures of docs/gallery.md into docs/img."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    mission = simulate_mission("corridor", n_scans=400, seed=0)
    picture(run_slam(mission.log, mission.rig, SlamConfig()), IMAGES / "demo.png", "simulated push-broom mission")
    office = simulate_mission("office", seed=0)
    plan(run_slam(office.log, office.rig, SlamConfig()), IMAGES / "office.png", "a simulated office")
    floor_plan_of_a_suite(IMAGES / "floor_plan.png")
    fleet_map(IMAGES / "joined.png")
    loop = data / "loop5" / "loop5.clf.gz"
    if loop.is_file():
        run, title = run_slam(*load(loop), SlamConfig()), "a corridor loop seen by one 2D laser"
        plan(run, IMAGES / "loop.png", title)
        page(run, IMAGES / "points.png", title, part="#points")
    for name, picture_name, title in (
        ("3dtk_corridor", "corridor.png", "a real corridor: three scans of a tilting laser"),
        ("balm_hall", "hall.png", "a real hall: 20 clouds of a spinning lidar, no odometry"),
    ):
        if (data / name).is_dir():
            page(run_slam(*load(data / name), SlamConfig()), IMAGES / picture_name, title)


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


def floor_plan_of_a_suite(path: Path) -> None:
    """The floor plan of a simulated office suite, as its SVG looks."""
    suite, rig = Suite.drawn(np.random.default_rng(0)), spinning_rig()
    way = suite.path()
    log, _ = record(Plan("suite", suite.world(), way, rig, SPACING), int(way.length_m / SPACING), 0)
    slam = run_slam(log, rig, SlamConfig(), batch=True).slam
    with tempfile.TemporaryDirectory() as scratch:
        drawn = Path(scratch) / "plan.svg"
        write_svg(drawn, floor_plan(joint_planes(slam.planes, slam.landmarks, slam.backend)))
        screenshot(drawn.as_uri(), path, "730,940")


def fleet_map(path: Path) -> None:
    """One map of robots that each drove through a part of a simulated office, in the colours of the missions."""
    missions = []
    for number, (start, end, backwards) in enumerate(VISITS):
        drive = make_drive(Recipe.parse("office/level"), seed=0, visit=number, part=(start, end), backwards=backwards)
        run = run_slam(drive.log, drive.rig, SlamConfig())
        missions.append(FinishedMission.of(f"robot {number + 1}", run.slam, drive.rig))
    (component,) = join(missions).components
    draw_missions(component, path)


def page(run: Run, path: Path, title: str, part: str = "") -> None:
    """The page of a run, or a `part` of it, as a browser shows it."""
    with tempfile.TemporaryDirectory() as scratch:
        with new_folder(Path(scratch) / "run") as folder:
            write_run(run, folder, title=title)
        screenshot((Path(scratch) / "run" / "report.html").as_uri() + part, path, "1100,645")


def screenshot(address: str, path: Path, size: str) -> None:
    """What a browser shows at an address; nothing without one."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print(f"no Chromium here: docs/img/{path.name} stays as it is")
        return
    with tempfile.TemporaryDirectory() as profile:
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={size}"]
        command = [browser, *flags, f"--user-data-dir={profile}", f"--screenshot={path}", address]
        subprocess.run(command, check=True, capture_output=True, timeout=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT.parent / "shared" / "data")
