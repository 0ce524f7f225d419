"""Commands that make a map, or data for one: slam, map, demo, simulate."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from slam.cli._job import JsonOption, MapOptions, OutOption, OverwriteOption, SlamOptions, of_options, open_job
from slam.cli._output import hint_of, progress_bar, say, say_verdict, show, show_result, warn_of

if TYPE_CHECKING:
    from slam.config import SlamConfig
    from slam.planeslam import PlaneSlam
    from slam.sensors.log import Log
    from slam.sensors.rig import Rig
    from slam.timing import StageClock


@of_options
def slam(options: SlamOptions) -> None:
    """Estimate trajectory and planes of LOG; what is measured is on disk before it is used."""
    if options.resume:
        _resume(options)
    else:
        _begin(options)


def _begin(options: SlamOptions) -> None:
    if options.log is None or options.out is None or options.salvage:
        raise typer.BadParameter("expected LOG --out DIR, or --resume RUN", param_hint="slam")
    if options.prior is None and (options.start is not None or options.start_sigma is not None):
        raise typer.BadParameter("expected --prior, the map that it is a place in", param_hint="--start")
    out = options.out
    log, rig, config, clock = open_job(options.log, out, options)
    from slam.frontend.keyframes import keyframes_of
    from slam.output.run_folder import Source, new_run
    from slam.session.prior_map import read_prior

    config = _with_strictness(config, options)
    known = None
    if options.prior is not None:
        start, sigma = options.start or "0,0,0", options.start_sigma or "0.3,6"
        known = read_prior(options.prior, start, sigma, lambda: next(keyframes_of(log, rig, config)))
    raw = "value" if options.keep_raw else "reference"
    source = Source(options.log, options.keep_partial, raw, options.forget_raw, options.odometry, tuple(log.assumed))
    begun = new_run(out, log, rig, config, source, prior=known, overwrite=options.overwrite)
    _go_on(begun, out, clock, options)


def _with_strictness(config: SlamConfig, options: SlamOptions) -> SlamConfig:
    if not options.strict:
        return config
    return config.model_copy(update={"keyframes": config.keyframes.model_copy(update={"strict": True})})


#: Options that go with --resume: all others are as the run began.
_OF_RESUMED = frozenset(
    ("log", "out", "resume", "salvage", "strict", "batch", "no_repair", "jobs", "timings", "strict_verdict", "as_json")
)


def _resume(options: SlamOptions) -> None:
    """Go on with a run; of one that is finished there is nothing to do, and that is no error."""
    folder, log = (options.log, None) if options.out is None else (options.out, options.log)
    given = {field.name for field in fields(options) if getattr(options, field.name)}
    if folder is None or given - _OF_RESUMED:
        raise typer.BadParameter("takes the folder of a run; all else is as the run began", param_hint="--resume")
    from slam.errors import check_folder_given
    from slam.timing import StageClock

    clock = StageClock()  # before the imports below: whoever waits for the command waits for them too
    check_folder_given(folder)
    from slam.output.run_folder import FinishedAlready, resumed_run
    from slam.session.store import salvage_session

    if options.salvage:
        say(salvage_session(folder))
    try:
        with clock.stage("replay"):
            _go_on(resumed_run(folder, log), folder, clock, options)
    except FinishedAlready as sentence:
        say(sentence)


def _go_on(
    begun: AbstractContextManager[tuple[PlaneSlam, Log, Rig]], folder: Path, clock: StageClock, options: SlamOptions
) -> None:
    """Bring a run to its end, with its results in its folder, and say what it came to and what was assumed for it."""
    from slam.ahead import cores
    from slam.output.run_files import write_run
    from slam.output.run_folder import conclude
    from slam.output.run_metrics import assumptions_of, metrics_of, warnings_of
    from slam.runs.slam_run import run_slam

    how = {"batch": options.batch, "repair": not options.no_repair, "jobs": options.jobs or cores()}
    with hint_of(folder), begun as (slam, log, rig), progress_bar("keyframes") as progress:
        config = _with_strictness(slam.config, options)
        run = run_slam(log, rig, config, slam=slam, clock=clock, progress=progress, **how)
        del slam  # as large as the run's own, which another is where it was repaired
        name = log.source.name
        with clock.stage("write"):
            conclude(run, folder, lambda work: write_run(run, work, title=f"spplanes slam {name}"))
        rows = metrics_of(run)
        warn_of(warnings_of(run))
        for sentence in assumptions_of(log):
            say(f"assumed: {sentence}")
        for repair in run.repairs or ():
            say(repair.sentence)
        show_result(name, rows, clock, folder, as_json=options.as_json, timings=options.timings)
    say_verdict(run.verdict, strict=options.strict_verdict)


@of_options
def map_(options: MapOptions) -> None:
    """The paper's mapping: planes of LOG at the poses it gives."""
    out = options.out
    log, rig, config, clock = open_job(options.log, out, options)
    from slam.files import new_folder
    from slam.output.run_files import write_map
    from slam.output.run_metrics import empty_map
    from slam.runs.mapping_run import run_map

    with progress_bar("scans") as progress:
        result = run_map(log, rig, config, clock=clock, progress=progress)
    with clock.stage("write"), new_folder(out, overwrite=options.overwrite) as folder:
        rows = write_map(result, folder, config, rig, title=f"spplanes map {options.log.name}", log=log)
    warn_of(empty_map(result.planes))
    for sentence in log.assumed:
        say(f"assumed: {sentence}")
    show_result(options.log.name, rows, clock, out, as_json=options.as_json, timings=options.timings)


def demo(
    out: OutOption = Path("demo"),
    scans: Annotated[int, Option(min=2, help="Push-broom scans of the mission.")] = 400,
    seed: Annotated[int, Option(min=0, help="Seed of all noise.")] = 0,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a corridor mission, map it with the poses unknown, and compare with the truth."""
    from slam.files import check_free, new_folder

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
    world: Annotated[str, Argument(help="World to drive through: corridor, office, room, or hall for 3D scans.")],
    out: OutOption,
    scans: Annotated[int | None, Option(min=2, help="Push-broom or 3D scans; default: the whole way.")] = None,
    seed: Annotated[int, Option(min=0, help="Seed of all noise.")] = 0,
    laps: Annotated[int, Option(min=1, help="Times round a world that is a loop.")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated mission: log, rig.yaml and the truth."""
    from slam.errors import check_world_given
    from slam.files import check_free, new_folder

    check_world_given(world)
    check_free(out, overwrite=overwrite)
    from slam.simulation import simulate_mission

    mission = simulate_mission(world, n_scans=scans, seed=seed, laps=laps)
    with new_folder(out, overwrite=overwrite) as folder:
        mission.save(folder)
