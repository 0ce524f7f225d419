"""The tasks of a fleet: pure functions of paths and bytes, done again anywhere with the same result."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

from factors.archive import ArchiveError
from slam.config import SlamConfig
from slam.frontend.range_noise import with_shown_errors
from slam.io.load import load
from slam.joining.mission import FinishedMission
from slam.joining.overlap import compare_missions
from slam.joining.records import (
    RecordError,
    comparison_to_bytes,
    finished_from_bytes,
    finished_to_bytes,
    mission_from_bytes,
    mission_to_bytes,
)
from slam.output.run_files import write_run
from slam.output.run_folder import Source, conclude, new_run
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Rig
from slam.session._file import fingerprint
from spplanes import __version__

#: The record of a mission in its run's folder.
RECORD_FILE = "mission.record"


@dataclass(frozen=True)
class Order:
    """A mission to be mapped: all that its result depends on."""

    name: str
    """What it is called in the joined map."""
    log: str
    """Path of the log, the same on every worker."""
    rig: str | None
    """Rig as JSON; None: the log's own, or a default."""
    config: str
    """Configuration as JSON."""
    store: str
    """Folder that keeps finished missions, the same on every worker."""
    keep_partial: bool = False
    """Use what precedes a cut in the log."""

    def key(self) -> str:
        """Content address: by log, rig, configuration and version.

        Raises:
            OSError: the log cannot be read.
        """
        what = [fingerprint(Path(self.log)), self.rig, self.config, self.keep_partial, __version__]
        return blake2b(json.dumps(what, sort_keys=True).encode(), digest_size=12).hexdigest()


@dataclass(frozen=True)
class Mapped:
    """What became of an order."""

    folder: str | None
    """The run's folder; None: the log could not be used."""
    reason: str = ""
    """Why not, one sentence."""
    record: bytes | None = None
    """The mission without its graph."""


def map_log(order: Order) -> Mapped:
    """Map a log into the store, unless it is there already.

    The work is done in a folder of its own and put into its place when it is finished: a worker may be killed at any
    moment, or two may do the same, and nothing is lost or done twice. A log that cannot be used is no error: the
    mission is named and left out.
    """
    try:
        key = order.key()
    except OSError as error:
        return Mapped(None, f"{order.log}: cannot be read ({error.strerror or error})")
    folder = Path(order.store) / key
    known = _record_in(folder)
    if known is None:
        try:
            _map(order, folder)
        except (ValueError, ImportError, ArchiveError) as error:
            return Mapped(None, " ".join(str(error).split()))
        known = _record_in(folder)
    if known is None:
        raise OSError(f"{folder}: cannot be read back")  # the store is not shared, or full: done again elsewhere
    return Mapped(str(folder), "", mission_to_bytes(known.mission))


def open_mapped(folder: str, name: str) -> FinishedMission:
    """A finished mission of the store, by the name it has in this fleet."""
    finished = finished_from_bytes((Path(folder) / RECORD_FILE).read_bytes())
    return replace(finished, mission=replace(finished.mission, name=name))


def compare_records(
    first: Mapped, second: Mapped, names: tuple[str, str], config: str, significance: float
) -> bytes | None:
    """Two missions compared; None where one could not be used."""
    if first.record is None or second.record is None:
        return None
    a = replace(mission_from_bytes(first.record), name=names[0])
    b = replace(mission_from_bytes(second.record), name=names[1])
    settings = SlamConfig.model_validate(json.loads(config))
    return comparison_to_bytes(compare_missions(a, b, settings, significance=significance))


def _map(order: Order, folder: Path) -> None:
    config = SlamConfig.model_validate(json.loads(order.config))
    rig = None if order.rig is None else Rig.model_validate_json(order.rig)
    path = Path(order.log)
    log, sensors = load(path, rig, keep_partial=order.keep_partial)
    sensors = with_shown_errors(log, sensors)
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        made = work / "run"
        source = Source(path, order.keep_partial, assumed=tuple(log.assumed))
        with new_run(made, log, sensors, config, source, prior=None, overwrite=False) as slam:
            run = run_slam(log, sensors, config, slam=slam)
            finished = FinishedMission.of(order.name, run.slam, sensors)
            conclude(run, made, lambda into: write_run(run, into, title=f"spplanes fleet {order.name}"))
        (made / RECORD_FILE).write_bytes(finished_to_bytes(finished))
        try:
            made.rename(folder)
        except OSError:  # another worker was first, and made the same; or what lies there is of no use
            if _record_in(folder) is None:
                shutil.rmtree(folder, ignore_errors=True)
                made.rename(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _record_in(folder: Path) -> FinishedMission | None:
    try:
        return finished_from_bytes((folder / RECORD_FILE).read_bytes())
    except (OSError, RecordError):
        return None
