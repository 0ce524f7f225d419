"""Commands on a finished run: evaluate, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli._job import JsonOption
from slam.cli._output import show


def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    truth: Annotated[Path, typer.Option("--truth", help="Simulated mission, TUM trajectory or relations.")],
    as_json: JsonOption = False,
) -> None:
    """Score RUN against the truth; the numbers also go into its metrics.json."""
    from slam.evaluation.folders import evaluate_run
    from slam.export import add_to_metrics

    rows = evaluate_run(run, truth)
    add_to_metrics(run, "evaluation", rows)
    show(f"{run.name} against {truth.name}", rows, as_json)


def export(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    to: Annotated[
        list[Path],
        typer.Option("--to", help="File to write, by its ending: .ply, .glb, .g2o, .tum, .kitti (or .kitti.txt)."),
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Write planes, graph or trajectory of RUN as files of other tools; --to may be given more than once."""
    from slam.targets import export_run

    for target in to:
        export_run(run, target, overwrite=overwrite)
