"""Commands that make a map: slam, map, demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli._job import (
    ConfigOption,
    JsonOption,
    KeepPartialOption,
    OutOption,
    OverwriteOption,
    RigOption,
    open_job,
)
from slam.cli._output import progress_bar, show, warn_of


def slam(
    log: Annotated[Path, typer.Argument(help="CARMEN log (.clf, .clf.gz), 3DTK folder or simulated mission.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: KeepPartialOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and planes of LOG."""
    from slam.export import new_folder, write_run
    from slam.metrics import metrics_of, warnings_of
    from slam.run import run_slam

    job = open_job(log, out, rig=rig, config=config, overwrite=overwrite, keep_partial=keep_partial)
    with progress_bar("keyframes") as progress:
        run = run_slam(job.log, job.rig, job.config, clock=job.clock, progress=progress)
    with new_folder(out, overwrite=overwrite) as folder:
        write_run(run, folder, title=f"spplanes slam {log.name}")
    show(f"{log.name}", metrics_of(run), as_json)
    warn_of(warnings_of(run))


def map_(
    log: Annotated[Path, typer.Argument(help="CARMEN log with poses, or simulated mission, of a push-broom laser.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: KeepPartialOption = False,
    as_json: JsonOption = False,
) -> None:
    """The paper's mapping: planes of LOG at the poses it gives."""
    from slam.export import new_folder, write_map
    from slam.mapping_run import run_map

    job = open_job(log, out, rig=rig, config=config, overwrite=overwrite, keep_partial=keep_partial)
    with progress_bar("scans") as progress:
        result = run_map(job.log, job.rig, job.config, clock=job.clock, progress=progress)
    with new_folder(out, overwrite=overwrite) as folder:
        rows = write_map(result, folder, job.config, job.rig, title=f"spplanes map {log.name}")
    show(f"{log.name}", rows, as_json)


def demo(
    out: OutOption = Path("demo"),
    scans: Annotated[int, typer.Option("--scans", min=2, help="Push-broom scans of the mission.")] = 400,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all noise.")] = 0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a corridor mission, map it with the poses unknown, and compare with the truth."""
    from slam.config import SlamConfig
    from slam.demo import compare
    from slam.export import check_free, new_folder, write_run
    from slam.run import StageClock, run_slam
    from slam.simulation import simulate_mission

    check_free(out, overwrite=overwrite)
    clock = StageClock()
    with clock.stage("simulate"):
        mission = simulate_mission("corridor", n_scans=scans, seed=seed)
    with progress_bar("keyframes") as progress:
        run = run_slam(mission.log, mission.rig, SlamConfig(), clock=clock, progress=progress)
    rows = compare(run, mission.truth)
    with new_folder(out, overwrite=overwrite) as folder:
        write_run(run, folder, title="spplanes demo", extra=[("estimate against truth", rows)])
    show("estimate against truth", rows, as_json)
    warn_of(run.slam.audit.warnings())
    if not as_json:
        typer.echo(f"Pictures and a page: {out / 'map.png'}, {out / 'report.html'}")
