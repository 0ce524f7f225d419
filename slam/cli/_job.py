"""The options that commands share, and what they read before they work."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from slam.cli._output import say

if TYPE_CHECKING:
    from slam.config import SlamConfig
    from slam.runs.slam_run import StageClock
    from slam.sensors.log import Log
    from slam.sensors.rig import Rig

OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; must not exist.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the folder if it exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the table as JSON.")]
RigOption = Annotated[Path | None, typer.Option("--rig", help="rig.yaml; without it the log's own or a default.")]
TimingsOption = Annotated[bool, typer.Option("--timings", help="Print the time of every stage.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML with values that differ from the defaults.")]
KeepPartialOption = Annotated[bool, typer.Option("--keep-partial", help="Use what precedes a cut in the log.")]


def of_options(command: Callable[[Any], None]) -> Callable[..., None]:
    """What typer takes for a command, out of a function of one dataclass: its fields are arguments and options."""
    kind = next(iter(get_type_hints(command).values()))

    @wraps(command)
    def run(**given: Any) -> None:
        command(kind(**given))

    run.__signature__ = inspect.signature(kind, eval_str=True)  # type: ignore[attr-defined]
    return run


@dataclass(frozen=True)
class MapOptions:
    """Of `spplanes map`."""

    log: Annotated[Path, typer.Argument(help="Log, folder or mission whose scans come with poses.")]
    out: OutOption
    rig: RigOption = None
    config: ConfigOption = None
    overwrite: OverwriteOption = False
    keep_partial: KeepPartialOption = False
    timings: TimingsOption = False
    as_json: JsonOption = False


@dataclass(frozen=True)
class SlamOptions:
    """Of `spplanes slam`."""

    log: Annotated[
        Path | None,
        typer.Argument(help="CARMEN log, ROS bag, folder of clouds or 3DTK scans, or simulated mission."),
    ] = None
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the results; must not exist.")] = None
    rig: RigOption = None
    odometry: Annotated[
        Path | None, typer.Option("--odometry", help="TUM file of odometry, of the body; in place of the log's own.")
    ] = None
    config: ConfigOption = None
    overwrite: OverwriteOption = False
    keep_partial: KeepPartialOption = False
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with a run that ended: --resume RUN, or LOG --out RUN --resume."),
    ] = False
    salvage: Annotated[
        bool, typer.Option("--salvage", help="With --resume: of a damaged session keep what is whole.")
    ] = False
    prior: Annotated[Path | None, typer.Option("--prior", help="Finished run (or planes.json) to localise in.")] = None
    start: Annotated[
        str | None,
        typer.Option("--start", help="With --prior: X,Y,HEADING or X,Y,Z,YAW,PITCH,ROLL (m, deg); or find (0,0,0)"),
    ] = None
    start_sigma: Annotated[
        str | None, typer.Option("--start-sigma", help="With --prior: standard deviations of that (default 0.3,6)")
    ] = None
    keep_raw: Annotated[bool, typer.Option("--keep-raw", help="Keep the raw scans in the session.")] = False
    forget_raw: Annotated[bool, typer.Option("--forget-raw", help="Keep measurements on disk, not in memory.")] = False
    strict: Annotated[bool, typer.Option("--strict", help="End the run at a scan that cannot be used.")] = False
    batch: Annotated[bool, typer.Option("--batch", help="Solve the graph once more as a whole at the end.")] = False
    no_repair: Annotated[bool, typer.Option("--no-repair", help="Leave a map that is found to be wrong as it is.")] = (
        False
    )
    topic: Annotated[
        list[str] | None, typer.Option("--topic", help="Of a bag: topic of scans to read; may be given several times.")
    ] = None
    odometry_topic: Annotated[str | None, typer.Option("--odometry-topic", help="Of a bag: topic of the odometry.")] = (
        None
    )
    odometry_frame: Annotated[
        str | None, typer.Option("--odometry-frame", help="Of a bag: frame that tf tells the odometry from.")
    ] = None
    body_frame: Annotated[str | None, typer.Option("--body-frame", help="Of a bag: frame of the robot's body.")] = None
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", min=1, help="Processes that measure keyframes; default: the cores there are."),
    ] = None
    timings: TimingsOption = False
    strict_verdict: Annotated[
        bool, typer.Option("--strict-verdict", help="Exit code 1 where the map is found to be broken.")
    ] = False
    as_json: JsonOption = False


def open_job(log: Path, out: Path, options: MapOptions | SlamOptions) -> tuple[Log, Rig, SlamConfig, StageClock]:
    """Read all that a command is given; whatever is wrong is said before any work is done."""
    from slam.errors import check_file_given, check_log_given
    from slam.files import check_free
    from slam.timing import StageClock

    clock = StageClock()  # before the imports below: whoever waits for the command waits for them too
    others = (options.odometry, options.prior) if isinstance(options, SlamOptions) else ()
    check_free(out, overwrite=options.overwrite, reads=(log, options.rig, options.config, *others))
    if isinstance(options, SlamOptions) and options.odometry is not None:
        for name, given in (("topic", options.odometry_topic), ("frame", options.odometry_frame)):
            if given is not None:
                raise ValueError(f"--odometry: expected one source of odometry, got --odometry-{name} too")
    for file in (options.rig, options.config):
        if file is not None:
            check_file_given(file)
    check_log_given(log)
    from slam.config import SlamConfig
    from slam.frontend.range_noise import with_shown_errors
    from slam.io.load import load
    from slam.io.rosbags.reader import Topics
    from slam.sensors.rig import Rig

    settings = SlamConfig() if options.config is None else SlamConfig.from_yaml(options.config)
    topics, odometry = Topics(), None
    if isinstance(options, SlamOptions):
        names = options.odometry_topic, options.odometry_frame, options.body_frame
        topics, odometry = Topics(tuple(options.topic or ()), *names), options.odometry
    with clock.stage("read"):
        described = None if options.rig is None else Rig.from_yaml(options.rig)
        read, sensors = load(log, described, keep_partial=options.keep_partial, topics=topics, odometry=odometry)
        sensors = with_shown_errors(read, sensors)
    for note in read.notes:
        say(f"{log.name}: {note}")
    return read, sensors, settings, clock
