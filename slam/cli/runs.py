"""Commands that make a map, or data for one: slam, map, demo, simulate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli._job import (
    BodyFrameOption,
    ConfigOption,
    JobsOption,
    JsonOption,
    KeepPartialOption,
    OdometryFrameOption,
    OdometryOption,
    OdometryTopicOption,
    OutOption,
    OverwriteOption,
    RigOption,
    TimingsOption,
    TopicOption,
    open_job,
)
from slam.cli._output import hint_of, progress_bar, say, say_verdict, show, show_result, warn_of

if TYPE_CHECKING:
    from slam.runs.slam_run import Run


def slam(
    log: Annotated[
        Path | None,
        typer.Argument(help="CARMEN log, ROS bag, folder of clouds or 3DTK scans, or simulated mission."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results; must not exist.")] = None,
    rig: RigOption = None,
    odometry: OdometryOption = None,
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
        str | None,
        typer.Option("--start", help="With --prior: X,Y,HEADING or X,Y,Z,YAW,PITCH,ROLL (m, deg); or find (0,0,0)"),
    ] = None,
    start_sigma: Annotated[
        str | None, typer.Option("--start-sigma", help="With --prior: standard deviations of that (default 0.3,6)")
    ] = None,
    keep_raw: Annotated[bool, typer.Option("--keep-raw", help="Keep the raw scans in the session.")] = False,
    forget_raw: Annotated[bool, typer.Option("--forget-raw", help="Keep measurements on disk, not in memory.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="End the run at a scan that cannot be used.")] = False,
    batch: Annotated[bool, typer.Option("--batch", help="Solve the graph once more as a whole at the end.")] = False,
    no_repair: Annotated[
        bool, typer.Option("--no-repair", help="Leave a map that is found to be wrong as it is.")
    ] = False,
    topic: TopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    odometry_frame: OdometryFrameOption = None,
    body_frame: BodyFrameOption = None,
    jobs: JobsOption = None,
    timings: TimingsOption = False,
    strict_verdict: Annotated[
        bool, typer.Option("--strict-verdict", help="Exit code 1 where the map is found to be broken.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and planes of LOG; what is measured is on disk before it is used."""
    given = {"rig": rig, "config": config, "odometry": odometry}
    frames = {"odometry_frame": odometry_frame, "body_frame": body_frame}
    bag = {"scans": tuple(topic or ()), "odometry": odometry_topic, **frames}
    if resume:
        run_folder, moved_to = (out, log) if out is not None else (log, None)
        begun_with = (*given.values(), *bag.values(), prior, start, start_sigma)
        if run_folder is None or any((*begun_with, overwrite, keep_partial, keep_raw, forget_raw)):
            raise typer.BadParameter("takes the folder of a run; all else is as the run began", param_hint="--resume")
        ending = {"as_json": as_json, "timings": timings, "strict_verdict": strict_verdict}
        _resume(run_folder, moved_to, salvage=salvage, jobs=jobs, **ending)
        return
    if log is None or out is None or salvage:
        raise typer.BadParameter("expected LOG --out DIR, or --resume RUN", param_hint="slam")
    if prior is None and (start is not None or start_sigma is not None):
        raise typer.BadParameter("expected --prior, the map that it is a place in", param_hint="--start")
    job = open_job(log, out, overwrite=overwrite, keep_partial=keep_partial, bag=bag, **given)
    from slam.ahead import cores
    from slam.frontend.keyframes import keyframes_of
    from slam.output.run_folder import Source, new_run
    from slam.runs.slam_run import run_slam
    from slam.session.prior_map import read_prior

    if strict:
        keyframes = job.config.keyframes.model_copy(update={"strict": True})
        job = job._replace(config=job.config.model_copy(update={"keyframes": keyframes}))
    known = None
    if prior is not None:
        known = read_prior(prior, start or "0,0,0", start_sigma or "0.3,6", lambda: next(keyframes_of(*job[:3])))
    raw = "value" if keep_raw else "reference"
    source = Source(log, keep_partial, raw, forget_raw, odometry, tuple(job.log.assumed))
    with (
        hint_of(out),
        new_run(out, job.log, job.rig, job.config, source, prior=known, overwrite=overwrite) as slam,
        progress_bar("keyframes") as progress,
    ):
        run = run_slam(
            *job[:3],
            slam=slam,
            batch=batch,
            repair=not no_repair,
            jobs=jobs or cores(),
            clock=job.clock,
            progress=progress,
        )
        _conclude(run, out, as_json=as_json, timings=timings)
    say_verdict(run.verdict, strict=strict_verdict)


def _resume(
    folder: Path,
    log: Path | None,
    *,
    salvage: bool,
    jobs: int | None,
    as_json: bool,
    timings: bool,
    strict_verdict: bool,
) -> None:
    """Go on with a run; of one that is finished there is nothing to do, and that is no error."""
    from slam.errors import check_folder_given
    from slam.timing import StageClock

    clock = StageClock()  # before the imports below: whoever waits for the command waits for them too
    check_folder_given(folder)
    from slam.ahead import cores
    from slam.output.run_folder import FinishedAlready, resumed_run
    from slam.runs.slam_run import run_slam
    from slam.session.salvage import salvage_session

    if salvage:
        say(salvage_session(folder).sentence)
    try:
        with hint_of(folder), clock.stage("replay"), resumed_run(folder, log) as (slam, read, rig):
            with progress_bar("keyframes") as progress:
                run = run_slam(read, rig, slam.config, slam=slam, jobs=jobs or cores(), clock=clock, progress=progress)
            _conclude(run, folder, as_json=as_json, timings=timings)
    except FinishedAlready as sentence:
        say(sentence)
    else:
        say_verdict(run.verdict, strict=strict_verdict)


def _conclude(run: Run, folder: Path, *, as_json: bool, timings: bool) -> None:
    """Write the results of a run into its folder; its table, what was assumed and what to know on the screen."""
    from slam.output.run_files import write_run
    from slam.output.run_folder import conclude
    from slam.output.run_metrics import assumptions_of, metrics_of, warnings_of

    name = run.log.source.name
    with run.clock.stage("write"):
        conclude(run, folder, lambda work: write_run(run, work, title=f"spplanes slam {name}"))
    rows = metrics_of(run)
    warn_of(warnings_of(run))
    for sentence in assumptions_of(run.log):
        say(f"assumed: {sentence}")
    for repair in run.repairs or ():
        say(repair.sentence)
    show_result(name, rows, run.clock, folder, as_json=as_json, timings=timings)


def map_(
    log: Annotated[Path, typer.Argument(help="Log, folder or mission whose scans come with poses.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: KeepPartialOption = False,
    timings: TimingsOption = False,
    as_json: JsonOption = False,
) -> None:
    """The paper's mapping: planes of LOG at the poses it gives."""
    job = open_job(log, out, rig=rig, config=config, overwrite=overwrite, keep_partial=keep_partial)
    from slam.output.new_folder import new_folder
    from slam.output.run_files import write_map
    from slam.output.run_metrics import empty_map
    from slam.runs.mapping_run import run_map

    with progress_bar("scans") as progress:
        result = run_map(job.log, job.rig, job.config, clock=job.clock, progress=progress)
    with result.clock.stage("write"), new_folder(out, overwrite=overwrite) as folder:
        rows = write_map(result, folder, job.config, job.rig, title=f"spplanes map {log.name}", log=job.log)
    warn_of(empty_map(result.planes))
    for sentence in job.log.assumed:
        say(f"assumed: {sentence}")
    show_result(log.name, rows, result.clock, out, as_json=as_json, timings=timings)


def demo(
    out: OutOption = Path("demo"),
    scans: Annotated[int, typer.Option("--scans", min=2, help="Push-broom scans of the mission.")] = 400,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all noise.")] = 0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a corridor mission, map it with the poses unknown, and compare with the truth."""
    from slam.output.new_folder import check_free, new_folder

    check_free(out, overwrite=overwrite)
    from slam.ahead import cores
    from slam.config import SlamConfig
    from slam.output.run_files import write_run
    from slam.output.run_metrics import metrics_against
    from slam.runs.slam_run import StageClock, run_slam
    from slam.simulation import simulate_mission

    clock = StageClock()
    with clock.stage("simulate"):
        mission = simulate_mission("corridor", n_scans=scans, seed=seed)
    with progress_bar("keyframes") as progress:
        run = run_slam(mission.log, mission.rig, SlamConfig(), jobs=cores(), clock=clock, progress=progress)
    rows = metrics_against(run, mission.truth)
    with new_folder(out, overwrite=overwrite) as folder:
        write_run(run, folder, title="spplanes demo", extra=[("estimate against truth", rows)])
    show("estimate against truth", rows, as_json)
    warn_of(run.slam.audit.warnings())
    say(f"results: {out}, the page: {out / 'report.html'}")
    say_verdict(run.verdict)


def simulate(
    world: Annotated[str, typer.Argument(help="World to drive through: corridor, office, room, or hall for 3D scans.")],
    out: OutOption,
    scans: Annotated[
        int | None, typer.Option("--scans", min=2, help="Push-broom or 3D scans; default: the whole way.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all noise.")] = 0,
    laps: Annotated[int, typer.Option("--laps", min=1, help="Times round a world that is a loop.")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated mission: log, rig.yaml and the truth."""
    from slam.errors import check_world_given
    from slam.output.new_folder import check_free, new_folder

    check_world_given(world)
    check_free(out, overwrite=overwrite)
    from slam.simulation import simulate_mission

    mission = simulate_mission(world, n_scans=scans, seed=seed, laps=laps)
    with new_folder(out, overwrite=overwrite) as folder:
        mission.save(folder)
