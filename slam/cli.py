"""The command line: thin; what a command needs is imported when it runs."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

if TYPE_CHECKING:
    from slam.config import SlamConfig
    from slam.evaluation.metrics import Metric
    from slam.io.log import Log
    from slam.rig import Rig
    from slam.run import StageClock

app = typer.Typer(
    name="spplanes",
    help="Planes with honest covariances, and plane-based SLAM on GTSAM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; must not exist.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the folder if it exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the table as JSON.")]
RigOption = Annotated[Path | None, typer.Option("--rig", help="rig.yaml; without it the log's own or a default.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML with values that differ from the defaults.")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: 0 done, 2 bad input or usage in one sentence on stderr, 1 anything else."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        app(args=list(arguments) if arguments is not None else None, prog_name="spplanes")
    except ValueError as error:
        _fail(error, 2)
    except KeyboardInterrupt:
        _fail("stopped", 1)
    except Exception as error:  # the boundary: whatever it is, no traceback
        _fail(f"unexpected {type(error).__name__}: {error}", 1)


def _fail(error: object, code: int) -> None:
    sentence = " ".join(str(error).split())
    print(f"spplanes: {sentence}", file=sys.stderr)
    sys.exit(code)


def _print_version(wanted: bool) -> None:
    if wanted:
        from spplanes._version import __version__

        typer.echo(f"spplanes {__version__}")
        raise typer.Exit


@app.callback()
def group(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Planes with honest covariances, and plane-based SLAM on GTSAM."""


@app.command()
def slam(
    log: Annotated[Path, typer.Argument(help="CARMEN log (.clf, .clf.gz), 3DTK folder or simulated mission.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: Annotated[bool, typer.Option("--keep-partial", help="Use what precedes a cut in the log.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate trajectory and planes of LOG."""
    from slam.export import new_folder, write_run
    from slam.metrics import metrics_of
    from slam.run import run_slam

    job = _open(log, out, rig=rig, config=config, overwrite=overwrite, keep_partial=keep_partial)
    with progress_bar("keyframes") as progress:
        run = run_slam(job.log, job.rig, job.config, clock=job.clock, progress=progress)
    with new_folder(out, overwrite=overwrite) as folder:
        write_run(run, folder, title=f"spplanes slam {log.name}")
    show(f"{log.name}", metrics_of(run), as_json)
    warn_of(run.slam.audit.warnings())


@app.command(name="map")
def map_(
    log: Annotated[Path, typer.Argument(help="CARMEN log with poses, or simulated mission, of a push-broom laser.")],
    out: OutOption,
    rig: RigOption = None,
    config: ConfigOption = None,
    overwrite: OverwriteOption = False,
    keep_partial: Annotated[bool, typer.Option("--keep-partial", help="Use what precedes a cut in the log.")] = False,
    as_json: JsonOption = False,
) -> None:
    """The paper's mapping: planes of LOG at the poses it gives."""
    from slam.export import new_folder, write_map
    from slam.mapping_run import run_map

    job = _open(log, out, rig=rig, config=config, overwrite=overwrite, keep_partial=keep_partial)
    with progress_bar("scans") as progress:
        result = run_map(job.log, job.rig, job.config, clock=job.clock, progress=progress)
    with new_folder(out, overwrite=overwrite) as folder:
        rows = write_map(result, folder, job.config, job.rig, title=f"spplanes map {log.name}")
    show(f"{log.name}", rows, as_json)


@app.command()
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


@app.command()
def simulate(
    world: Annotated[str, typer.Argument(help="World to drive through, such as corridor.")],
    out: OutOption,
    scans: Annotated[
        int | None, typer.Option("--scans", min=2, help="Push-broom scans; default: the whole world.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all noise.")] = 0,
    laps: Annotated[int, typer.Option("--laps", min=1, help="Times round a world that is a loop.")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated mission: log, rig.yaml and the truth."""
    from slam.export import check_free, new_folder
    from slam.simulation import simulate_mission

    check_free(out, overwrite=overwrite)
    mission = simulate_mission(world, n_scans=scans, seed=seed, laps=laps)
    with new_folder(out, overwrite=overwrite) as folder:
        mission.save(folder)


@app.command()
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


class _Job(NamedTuple):
    """What a command works on."""

    log: Log
    rig: Rig
    config: SlamConfig
    clock: StageClock


def _open(log: Path, out: Path, *, rig: Path | None, config: Path | None, overwrite: bool, keep_partial: bool) -> _Job:
    """Read all that a command is given; whatever is wrong is said before any work is done."""
    from slam.config import SlamConfig
    from slam.export import check_free
    from slam.io.load import load
    from slam.rig import Rig
    from slam.run import StageClock

    check_free(out, overwrite=overwrite)
    settings = SlamConfig() if config is None else SlamConfig.from_yaml(config)
    clock = StageClock()
    with clock.stage("read"):
        read, sensors = load(log, None if rig is None else Rig.from_yaml(rig), keep_partial=keep_partial)
    return _Job(read, sensors, settings, clock)


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, where stderr is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(name, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def show(title: str, rows: Sequence[Metric], as_json: bool) -> None:
    """Print a table of metric, value, unit; or the same as JSON."""
    if as_json:
        import json

        from slam.export import as_json as rows_as_json

        print(json.dumps(rows_as_json(rows), indent=1))
        return
    from rich.console import Console
    from rich.table import Table

    from slam.report import format_value

    table = Table(title=title, title_justify="left")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for row in rows:
        table.add_row(row.name, format_value(row.value), row.unit)
    Console().print(table)


def warn_of(sentences: Sequence[str]) -> None:
    """One line each on stderr."""
    for sentence in sentences:
        typer.echo(f"warning: {sentence}", err=True)


if __name__ == "__main__":
    main()
