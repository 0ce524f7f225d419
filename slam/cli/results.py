"""Commands on a finished run: evaluate."""

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
