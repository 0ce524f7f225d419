"""Pictures and the page of a finished run, from its folder alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.files import whole_file
from slam.runs.stored_run import StoredRun
from slam.visualization.pictures import draw_one, draw_uncertainty
from slam.visualization.report import write_report
from slam.visualization.rerun_export import write_rerun
from slam.visualization.scene import scene_of


def view_run(run: Path | str, out: Path | str | None = None, *, recording: Path | None = None) -> list[Path]:
    """Draw plan.png, side.png, uncertainty.png and report.html of a run; returns what was written.

    Args:
        run: its folder.
        out: folder for the pictures; None: the run's own, whose older pictures are replaced.
        recording: file for a recording for the Rerun viewer, .rrd; None: none is made.

    Raises:
        ImportError: a recording without the Rerun SDK.
        LogError: no run, or a file of it that is missing or broken.
        ValueError: a place where nothing can be written.
    """
    stored = StoredRun.read(run)
    doubtful = () if stored.verdict is None else stored.verdict.keyframes
    folder = stored.folder if out is None else Path(out)
    pictures: dict[str, Callable[[Path], None]] = {
        "plan.png": lambda path: draw_one(stored, "plan", path, doubtful),
        "side.png": lambda path: draw_one(stored, "side", path, doubtful),
        "uncertainty.png": lambda path: draw_uncertainty(stored, stored.history, path),
    }
    for name, draw in pictures.items():
        with whole_file(folder / name) as scratch:
            draw(scratch)
    drawn = [folder / name for name in pictures]
    with whole_file(folder / "report.html") as scratch:
        scene = scene_of(stored, stored.history, doubtful)
        title = f"spplanes: {stored.folder.resolve().name}"
        write_report(scratch, title, stored.tables, drawn, scene, stored.verdict)
    if recording is not None:
        with whole_file(recording) as scratch:
            write_rerun(stored, scratch)
    return [*drawn, folder / "report.html", *([] if recording is None else [recording])]
