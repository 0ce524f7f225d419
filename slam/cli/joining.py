"""The command that makes one map of many missions: join."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli._job import ConfigOption, JsonOption, OutOption, OverwriteOption
from slam.cli._output import progress_bar, say, show, warn_of


def join(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs, two or more.")],
    out: OutOption,
    config: ConfigOption = None,
    significance: Annotated[
        float, typer.Option("--significance", help="Probability of joining missions that do not overlap.")
    ] = 1e-3,
    strict: Annotated[
        bool, typer.Option("--strict", help="End where a run cannot be used; else it is left out.")
    ] = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """One map of several finished RUNs, wherever each began: planes seen by several once, a trajectory for each."""
    from slam.config import SlamConfig
    from slam.joining import join as join_runs
    from slam.output.joined_folder import warnings_of, write_joined
    from slam.output.run_files import check_free, new_folder

    check_free(out, overwrite=overwrite)
    settings = SlamConfig() if config is None else SlamConfig.from_yaml(config)
    with progress_bar("pairs of missions") as progress:
        joined = join_runs(runs, config=settings, significance=significance, strict=strict, progress=progress)
    with new_folder(out, overwrite=overwrite) as folder:
        rows = write_joined(joined, folder, title=f"spplanes join {out.name}")
    warn_of(warnings_of(joined))
    show(f"{len(runs)} missions", rows, as_json)
    say(f"results: {out}, the page: {out / 'report.html'}")
