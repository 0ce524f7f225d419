"""The options that commands share, and what they read before they work."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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
TopicOption = Annotated[
    list[str] | None, typer.Option("--topic", help="Of a bag: topic of scans to read; may be given several times.")
]
OdometryTopicOption = Annotated[str | None, typer.Option("--odometry-topic", help="Of a bag: topic of the odometry.")]
OdometryFrameOption = Annotated[
    str | None, typer.Option("--odometry-frame", help="Of a bag: frame that tf tells the odometry from.")
]
BodyFrameOption = Annotated[str | None, typer.Option("--body-frame", help="Of a bag: frame of the robot's body.")]
OdometryOption = Annotated[
    Path | None, typer.Option("--odometry", help="TUM file of odometry, of the body; in place of the log's own.")
]
TimingsOption = Annotated[bool, typer.Option("--timings", help="Print the time of every stage.")]
JobsOption = Annotated[
    int | None,
    typer.Option("--jobs", min=1, help="Processes that measure keyframes; default: the cores there are."),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="YAML with values that differ from the defaults.")]
KeepPartialOption = Annotated[bool, typer.Option("--keep-partial", help="Use what precedes a cut in the log.")]


class Job(NamedTuple):
    """What a command works on."""

    log: Log
    rig: Rig
    config: SlamConfig
    clock: StageClock


def open_job(
    log: Path,
    out: Path,
    *,
    rig: Path | None,
    config: Path | None,
    overwrite: bool,
    keep_partial: bool,
    odometry: Path | None = None,
    bag: Mapping[str, Any] = {},
) -> Job:
    """Read all that a command is given; whatever is wrong is said before any work is done.

    `bag` has the fields of `slam.io.rosbags.reader.Topics`, which are not imported for it.
    """
    from slam.errors import check_file_given, check_log_given
    from slam.output.new_folder import check_free
    from slam.timing import StageClock

    clock = StageClock()  # before the imports below: whoever waits for the command waits for them too
    check_free(out, overwrite=overwrite)
    for name, key in (("--odometry-topic", "odometry"), ("--odometry-frame", "odometry_frame")):
        if odometry is not None and bag.get(key) is not None:
            raise ValueError(f"--odometry: expected one source of odometry, got {name} too")
    for file in (rig, config):
        if file is not None:
            check_file_given(file)
    check_log_given(log)
    from slam.config import SlamConfig
    from slam.frontend.range_noise import with_shown_errors
    from slam.io.load import load
    from slam.io.rosbags.reader import Topics
    from slam.sensors.rig import Rig

    settings = SlamConfig() if config is None else SlamConfig.from_yaml(config)
    with clock.stage("read"):
        described = None if rig is None else Rig.from_yaml(rig)
        read, sensors = load(log, described, keep_partial=keep_partial, topics=Topics(**bag), odometry=odometry)
        sensors = with_shown_errors(read, sensors)
    for note in read.notes:
        say(f"{log.name}: {note}")
    return Job(read, sensors, settings, clock)
