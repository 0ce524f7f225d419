"""Commands that make a map: slam, map, demo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli._job import (
    ConfigOption,
    JsonOption,
    KeepPartialOption,
    OdometryTopicOption,
    OutOption,
    OverwriteOption,
    RigOption,
    TopicOption,
    open_job,
)
from slam.cli._output import hint_of, progress_bar, say, say_verdict, show, warn_of

if TYPE_CHECKING:
    from slam.runs.slam_run import Run


def slam(
    log: Annotated[
        Path | None,
        typer.Argument(help="CARMEN log, ROS bag, folder of clouds or 3DTK scans, or simulated mission."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results; must not exist.")] = None,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: KeepPartialOption = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with a run that ended: --resume RUN, or LOG --out RUN --resume."),
    ] = False,
    salvage: Annotated[
        bool, typer.Option("--salvage", help="With --resume: of a damaged session keep what is whole.")
    ] = False,
    prior: Annotated[Path | None, typer.Option("--prior", help="Finished run (or planes.json) to localise in.")] = None,
    start: Annotated[
        str, typer.Option("--start", help="With --prior: its first X,Y,HEADING (m, deg), or find.")
    ] = "0,0,0",
    start_sigma: Annotated[
        str, typer.Option("--start-sigma", help="With --prior: standard deviations of that (m, deg).")
    ] = "0.3,6",
    keep_raw: Annotated[bool, typer.Option("--keep-raw", help="Keep the raw scans in the session.")] = False,
    forget_raw: Annotated[bool, typer.Option("--forget-raw", help="Keep measurements on disk, not in memory.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="End the run at a scan that cannot be used.")] = False,
    batch: Annotated[bool, typer.Option("--batch", help="Solve the graph once more as a whole at the end.")] = False,
    topic: TopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    strict_verdict: Annotated[
        bool, typer.Option("--strict-verdict", help="Exit code 1 where the map is found to be broken.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and planes of LOG; what is measured is on disk before it is used."""
    if resume:
        run_folder, moved_to = (out, log) if out is not None else (log, None)
        if run_folder is None or rig or config or prior or overwrite or keep_partial or keep_raw or forget_raw:
            raise typer.BadParameter("takes the folder of a run; all else is as the run began", param_hint="--resume")
        _resume(run_folder, moved_to, salvage=salvage, as_json=as_json, strict_verdict=strict_verdict)
        return
    if log is None or out is None or salvage:
        raise typer.BadParameter("expected LOG --out DIR, or --resume RUN", param_hint="slam")
    from slam.cli._prior import read_prior
    from slam.frontend.keyframes import keyframes_of
    from slam.output.run_folder import Source, new_run
    from slam.runs.slam_run import run_slam

    job = open_job(
        log,
        out,
        rig=rig,
        config=config,
        overwrite=overwrite,
        keep_partial=keep_partial,
        topics=topic,
        odometry_topic=odometry_topic,
    )
    if strict:
        keyframes = job.config.keyframes.model_copy(update={"strict": True})
        job = job._replace(config=job.config.model_copy(update={"keyframes": keyframes}))
    known = None if prior is None else read_prior(prior, start, start_sigma, lambda: next(keyframes_of(*job[:3])))
    source = Source(log, keep_partial, "value" if keep_raw else "reference", forget_raw)
    with (
        hint_of(out),
        new_run(out, job.log, job.rig, job.config, source, prior=known, overwrite=overwrite) as slam,
        progress_bar("keyframes") as progress,
    ):
        run = run_slam(job.log, job.rig, job.config, slam=slam, batch=batch, clock=job.clock, progress=progress)
        _conclude(run, out, as_json)
    say_verdict(run.verdict, strict=strict_verdict)


def _resume(folder: Path, log: Path | None, *, salvage: bool, as_json: bool, strict_verdict: bool) -> None:
    """Go on with a run."""
    from slam.output.run_folder import resumed_run
    from slam.runs.slam_run import StageClock, run_slam
    from slam.session.salvage import salvage_session

    if salvage:
        say(salvage_session(folder).sentence)
    clock = StageClock()
    with hint_of(folder), clock.stage("replay"), resumed_run(folder, log) as (slam, read, rig):
        with progress_bar("keyframes") as progress:
            run = run_slam(read, rig, slam.config, slam=slam, clock=clock, progress=progress)
        _conclude(run, folder, as_json)
    say_verdict(run.verdict, strict=strict_verdict)


def _conclude(run: Run, folder: Path, as_json: bool) -> None:
    """Write the results of a run into its folder, and its table on the screen."""
    from slam.output.run_files import write_run
    from slam.output.run_folder import conclude
    from slam.output.run_metrics import metrics_of, warnings_of

    name = run.log.source.name
    conclude(run.slam, folder, lambda work: write_run(run, work, title=f"spplanes slam {name}"))
    show(name, metrics_of(run), as_json)
    warn_of(warnings_of(run))


def map_(
    log: Annotated[Path, typer.Argument(help="Log, folder or mission whose scans come with poses.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: KeepPartialOption = False,
    as_json: JsonOption = False,
) -> None:
    """The paper's mapping: planes of LOG at the poses it gives."""
    from slam.output.run_files import new_folder, write_map
    from slam.runs.mapping_run import run_map

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
    from slam.output.run_files import check_free, new_folder, write_run
    from slam.runs.demo import compare
    from slam.runs.slam_run import StageClock, run_slam
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
    say_verdict(run.verdict)
    if not as_json:
        typer.echo(f"Pictures and a page: {out / 'map.png'}, {out / 'report.html'}")
