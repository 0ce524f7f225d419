"""The commands that make one map of many missions: join, fleet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from slam.cli._job import (
    ConfigOption,
    JsonOption,
    KeepPartialOption,
    OutOption,
    OverwriteOption,
    RigOption,
    of_options,
    read_config,
    read_rig,
)
from slam.cli._output import progress_bar, say, show, warn_of

if TYPE_CHECKING:
    from slam.joining import JoinedMap

SignificanceOption = Annotated[float, Option(help="Probability of joining missions that do not overlap.")]


def join(
    runs: Annotated[list[Path], Argument(help="Folders of finished runs, two or more.")],
    out: OutOption,
    config: ConfigOption = None,
    significance: SignificanceOption = 1e-3,
    strict: Annotated[bool, Option("--strict", help="End where a run cannot be used; else it is left out.")] = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """One map of several finished RUNs, wherever each began: planes seen by several once, a trajectory for each."""
    from slam.files import check_free

    check_free(out, overwrite=overwrite, reads=(*runs, config))
    from slam.joining import join as join_runs

    settings = read_config(config)
    with progress_bar("pairs of missions") as progress:
        joined = join_runs(runs, config=settings, significance=significance, strict=strict, progress=progress)
    _write(joined, out, f"{len(runs)} missions", overwrite=overwrite, as_json=as_json)


@dataclass(frozen=True)
class FleetOptions:
    """Of `spplanes fleet`."""

    logs: Annotated[list[Path], Argument(help="Logs of missions, two or more.")]
    out: OutOption
    rig: RigOption = None
    config: ConfigOption = None
    scheduler: Annotated[str | None, Option(help="Of a Dask cluster: tcp://HOST:PORT.")] = None
    scheduler_file: Annotated[Path | None, Option(help="File that a Dask scheduler wrote its address into.")] = None
    workers: Annotated[int | None, Option(min=1, help="Processes on this machine; default: one for each core.")] = None
    memory: Annotated[str, Option(help="Of each process on this machine, such as 4GB.")] = "auto"
    store: Annotated[Path | None, Option(help="Folder of finished missions, shared; default: OUT.missions.")] = None
    significance: SignificanceOption = 1e-3
    strict: Annotated[bool, Option("--strict", help="End where a log cannot be used; else it is left out.")] = False
    resume: Annotated[bool, Option("--resume", help="Go on; of a fleet that has finished nothing is left.")] = False
    keep_partial: KeepPartialOption = False
    overwrite: OverwriteOption = False
    as_json: JsonOption = False


@of_options
def fleet(options: FleetOptions) -> None:
    """Map many LOGs at once, on this machine or on a Dask cluster, and join the missions into one map."""
    from slam.files import check_free

    logs, out = options.logs, options.out
    is_remote = options.scheduler is not None or options.scheduler_file is not None
    if options.scheduler is not None and options.scheduler_file is not None:
        raise ValueError("--scheduler: expected one cluster, got --scheduler-file too")
    if is_remote and options.workers is not None:
        raise ValueError("--workers: expected without a scheduler, whose cluster has workers of its own")
    if options.resume and (out / "joins.json").is_file():
        say(f"{out}: finished already; nothing is left to do")
        return
    check_free(out, overwrite=options.overwrite, reads=(*logs, options.rig, options.config, options.store))
    if len(logs) < 2:  # before a cluster is started for it
        raise ValueError(f"LOG: expected at least two, got {len(logs)}")
    store = out.with_name(f"{out.name}.missions") if options.store is None else options.store
    joined = _run_fleet(options, store, is_remote)
    _write(joined, out, f"{len(logs)} missions", overwrite=options.overwrite, as_json=options.as_json)
    say(f"missions: {store}")


def _run_fleet(options: FleetOptions, store: Path, is_remote: bool) -> JoinedMap:
    """The missions mapped and joined, on a cluster that is there or on processes of this machine."""
    from slam.fleet import has_dashboard, local_client, remote_client, run

    config, rig = read_config(options.config), read_rig(options.rig)
    if is_remote:
        client = remote_client(options.scheduler, options.scheduler_file)
    else:
        client = local_client(options.workers, options.memory)
    with client, progress_bar("missions and pairs") as progress:
        if has_dashboard():
            say(f"dashboard: {client.dashboard_link}")
        done, count = {"missions": 0, "pairs": 0}, len(options.logs)

        def tell(what: str, so_many: int, _: int) -> None:
            done[what] = so_many
            progress(sum(done.values()), count + count * (count - 1) // 2)

        return run(
            options.logs,
            store,
            client=client,
            rig=rig,
            config=config,
            significance=options.significance,
            strict=options.strict,
            keep_partial=options.keep_partial,
            progress=tell,
        )


def _write(joined: JoinedMap, out: Path, title: str, *, overwrite: bool, as_json: bool) -> None:
    """The folder of a joined map; its table and what to know on the screen."""
    from slam.files import new_folder
    from slam.output.joined_folder import warnings_of, write_joined

    with new_folder(out, overwrite=overwrite) as folder:
        rows = write_joined(joined, folder, title=f"spplanes {out.name}")
    warn_of(warnings_of(joined))
    show(title, rows, as_json)
    say(f"results: {out}, the page: {out / 'report.html'}")
