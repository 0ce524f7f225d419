"""Make the figures of the README: `python tools/figures.py [FOLDER_OF_REAL_DATA]`.

The simulated one always; the one of the real corridor where the data are.
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.figure import Figure

from slam.config import SlamConfig
from slam.io.load import load
from slam.pictures import draw_view
from slam.run import Run, run_slam
from slam.simulation import simulate_mission

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "img"


def main(data: Path) -> None:
    """Write docs/img/*.png."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    mission = simulate_mission("corridor", n_scans=400, seed=0)
    picture(run_slam(mission.log, mission.rig, SlamConfig()), IMAGES / "demo.png", "simulated push-broom mission")
    corridor = data / "3dtk_corridor"
    if corridor.is_dir():
        log, rig = load(corridor)
        picture(run_slam(log, rig, SlamConfig()), IMAGES / "corridor.png", "three scans of a real corridor")


def picture(run: Run, path: Path, title: str) -> None:
    """Plan and side view, small enough for a README."""
    figure = Figure(figsize=(8.0, 5.2), layout="constrained")
    plan, side = figure.subplots(2, 1, height_ratios=[2, 1], sharex=True)
    draw_view(plan, run, "plan")
    draw_view(side, run, "side")
    plan.set_title(f"{title}: {len(run.planes)} planes, {len(run.trajectory)} poses", fontsize=10)
    plan.legend(loc="upper right", fontsize=7)
    figure.savefig(path, dpi=80, metadata={"Software": None})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT.parent / "shared" / "data")
