"""The options that commands share, and what they read before they work."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from typer import Argument, Option

from slam.cli._output import say

if TYPE_CHECKING:
    from slam.config import SlamConfig
    from slam.runs.slam_run import StageClock
    from slam.sensors.log import Log
    from slam.sensors.rig import Rig

OutOption = Annotated[Path, Option("--out", help="Folder for the results; must not exist.")]
OverwriteOption = Annotated[bool, Option("--overwrite", help="Replace the folder if it exists.")]
JsonOption = Annotated[bool, Option("--json", help="Print the table as JSON.")]
RigOption = Annotated[Path | None, Option("--rig", help="rig.yaml; without it the log's own or a default.")]
TimingsOption = Annotated[bool, Option("--timings", help="Print the time of every stage.")]
ConfigOption = Annotated[Path | None, Option("--config", help="YAML with values that differ from the defaults.")]
KeepPartialOption = Annotated[bool, Option("--keep-partial", help="Use what precedes a cut in the log.")]


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

    log: Annotated[Path, Argument(help="Log, folder or mission whose scans come with poses.")]
    out: OutOption
    rig: RigOption = None
    config: ConfigOption = None
    overwrite: OverwriteOption = False
    keep_partial: KeepPartialOption = False
    timings: TimingsOption = False
    as_json: JsonOption = False
    odometry = prior = topic = odometry_topic = odometry_frame = body_frame = None  # `slam` alone has such options


@dataclass(frozen=True)
class SlamOptions:
    """Of `spplanes slam`."""

    log: Annotated[
        Path | None, Argument(help="CARMEN log, ROS bag, folder of clouds or 3DTK scans, or simulated mission.")
    ] = None
    out: Annotated[Path | None, Option(help="Folder for the results; must not exist.")] = None
    rig: RigOption = None
    odometry: Annotated[Path | None, Option(help="TUM file of odometry, of the body; in place of the log's own.")] = (
        None
    )
    config: ConfigOption = None
    overwrite: OverwriteOption = False
    keep_partial: KeepPartialOption = False
    resume: Annotated[
        bool, Option("--resume", help="Go on with a run that ended: --resume RUN, or LOG --out RUN --resume.")
    ] = False
    salvage: Annotated[bool, Option("--salvage", help="With --resume: of a damaged session keep what is whole.")] = (
        False
    )
    prior: Annotated[Path | None, Option(help="Finished run (or planes.json) to localise in.")] = None
    start: Annotated[
        str | None, Option(help="With --prior: X,Y,HEADING or X,Y,Z,YAW,PITCH,ROLL (m, deg); or find (0,0,0)")
    ] = None
    start_sigma: Annotated[str | None, Option(help="With --prior: standard deviations of that (default 0.3,6)")] = None
    keep_raw: Annotated[bool, Option("--keep-raw", help="Keep the raw scans in the session.")] = False
    forget_raw: Annotated[bool, Option("--forget-raw", help="Keep measurements on disk, not in memory.")] = False
    strict: Annotated[bool, Option("--strict", help="End the run at a scan that cannot be used.")] = False
    batch: Annotated[bool, Option("--batch", help="Solve the graph once more as a whole at the end.")] = False
    no_repair: Annotated[bool, Option("--no-repair", help="Leave a map that is found to be wrong as it is.")] = False
    topic: Annotated[list[str] | None, Option(help="Of a bag: topic of scans to read; may be given several times.")] = (
        None
    )
    odometry_topic: Annotated[str | None, Option(help="Of a bag: topic of the odometry.")] = None
    odometry_frame: Annotated[str | None, Option(help="Of a bag: frame that tf tells the odometry from.")] = None
    body_frame: Annotated[str | None, Option(help="Of a bag: frame of the robot's body.")] = None
    jobs: Annotated[
        int | None, Option(min=1, help="Processes that measure keyframes; default: the cores there are.")
    ] = None
    timings: TimingsOption = False
    strict_verdict: Annotated[
        bool, Option("--strict-verdict", help="Exit code 1 where the map is found to be broken.")
    ] = False
    as_json: JsonOption = False


def open_job(log: Path, out: Path, options: MapOptions | SlamOptions) -> tuple[Log, Rig, SlamConfig, StageClock]:
    """Read all that a command is given; whatever is wrong is said before any work is done."""
    from slam.errors import check_file_given, check_log_given
    from slam.files import check_free
    from slam.timing import StageClock

    clock = StageClock()  # before the imports below: whoever waits for the command waits for them too
    reads = (log, options.rig, options.config, options.odometry, options.prior)
    check_free(out, overwrite=options.overwrite, reads=reads)
    for name in ("topic", "frame"):
        if options.odometry is not None and getattr(options, f"odometry_{name}") is not None:
            raise ValueError(f"--odometry: expected one source of odometry, got --odometry-{name} too")
    for file in (options.rig, options.config):
        if file is not None:
            check_file_given(file)
    check_log_given(log)
    from slam.frontend.range_noise import with_shown_errors
    from slam.io.load import load
    from slam.io.rosbags.reader import Topics

    settings = read_config(options.config)
    topics = Topics(tuple(options.topic or ()), options.odometry_topic, options.odometry_frame, options.body_frame)
    with clock.stage("read"):
        partial, odometry = options.keep_partial, options.odometry
        read, sensors = load(log, read_rig(options.rig), keep_partial=partial, topics=topics, odometry=odometry)
        sensors = with_shown_errors(read, sensors)
    for note in read.notes:
        say(f"{log.name}: {note}")
    return read, sensors, settings, clock


def read_config(path: Path | None) -> SlamConfig:
    """What --config says, or the defaults."""
    from slam.config import SlamConfig

    return SlamConfig() if path is None else SlamConfig.from_yaml(path)


def read_rig(path: Path | None) -> Rig | None:
    """What --rig says."""
    from slam.sensors.rig import Rig

    return None if path is None else Rig.from_yaml(path)
