"""Fleet: many missions on Dask (extra `fleet`): every log a task, every pair of missions a task, one map at the end.

Tasks are functions of what they are given, done again anywhere with the same result.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factors.archive import ArchiveError
from slam.config import SlamConfig
from slam.files import scratch_folder
from slam.frontend.range_noise import with_shown_errors
from slam.io.load import load
from slam.joining.join import SIGNIFICANCE, joined_by, names_of
from slam.joining.joined_map import JoinedMap
from slam.joining.mission import FinishedMission, Mission, RecordError
from slam.joining.overlap import Comparison, compare_missions
from slam.output.run_files import write_run
from slam.output.run_folder import Source, conclude, new_run
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Rig
from slam.session._file import fingerprint
from spplanes import __version__

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[str, int, int], None]

#: A task is tried again so often when its worker is killed or the store fails it.
RETRIES = 10
#: The record of a mission in its run's folder.
RECORD_FILE = "mission.record"


class FleetError(OSError):
    """The cluster is gone, or cannot be reached; what is finished is kept."""


def run(
    logs: Sequence[Path | str],
    store: Path | str,
    *,
    client: Client | None = None,
    rig: Rig | None = None,
    config: SlamConfig | None = None,
    significance: float = SIGNIFICANCE,
    strict: bool = False,
    keep_partial: bool = False,
    progress: Progress | None = None,
) -> JoinedMap:
    """Map many logs on a cluster, and join the missions.

    Every log is one task, every pair of missions another; the joint solution is made here. What travels are missions
    without their graphs. Finished missions are kept in the store by their content (log, rig, configuration, version)
    and never mapped again: a fleet that was killed goes on by being run again.

    Args:
        logs: one for each mission; their paths hold on every worker.
        store: folder for the finished missions; its path holds on every worker.
        client: of the cluster; None: that of Dask's configuration (`scheduler-address`), or processes on this machine.
        rig: of all missions; None: each log's own, or a default.
        config: of mapping and of joining; None: the defaults.
        significance: as for `slam.joining.join`.
        strict: a log that cannot be used ends it; otherwise its mission is left out and named.
        keep_partial: use what precedes a cut in a log.
        progress: is told what is done ("missions", "pairs"), how many are, and how many there are.

    Raises:
        ValueError: fewer than two logs, one given twice; a log that cannot be used where `strict`, or none that can.
        ImportError: without Dask distributed.
        FleetError: the cluster is gone.
    """
    if not 0.0 < significance < 0.5:
        raise ValueError(f"significance: expected a probability in (0, 0.5), got {significance}")
    if len(logs) < 2:
        raise ValueError(f"logs: expected at least two, got {len(logs)}")
    config, store, named = config or SlamConfig(), Path(store).resolve(), zip(names_of(logs), logs, strict=True)
    orders = [Order(name, Path(log).resolve(), rig, config, store, keep_partial) for name, log in named]
    pairs = list(combinations(range(len(orders)), 2))
    with local_client() if client is None else nullcontext(client) as used:
        submit = partial(used.submit, pure=True, retries=RETRIES)
        mapped = [submit(map_log, one) for one in orders]
        compared = [submit(compare_mapped, mapped[a], mapped[b], config, significance / len(pairs)) for a, b in pairs]
        done = dict(zip((one.name for one in orders), _gathered(used, mapped, "missions", progress), strict=True))
        left_out = {name: one.reason for name, one in done.items() if one.folder is None}
        if left_out and (strict or len(left_out) == len(orders)):
            some, (name, reason) = len(left_out), next(iter(left_out.items()))
            raise ValueError(f"logs: expected ones that can be mapped, got {some} that cannot ({name}: {reason})")
        comparisons = [one for one in _gathered(used, compared, "pairs", progress) if one is not None]
        folders = {name: one.folder for name, one in done.items() if one.folder is not None}
        missions = {name: open_mapped(folder, name) for name, folder in folders.items()}
        return replace(joined_by(missions, comparisons, config, left_out), folders=folders)


def local_client(workers: int | None = None, memory: str = "auto") -> Client:
    """A client of the cluster that Dask's configuration names, else of processes on this machine.

    Args:
        workers: processes, of one thread each; None: one for each core.
        memory: that each may take, as Dask says it ("4GB"); "auto": its share of the machine's. A worker that goes
            beyond is ended and its tasks are done again elsewhere.
    """
    dask, distributed = _dask()
    if workers is None and dask.config.get("scheduler-address", None):
        return distributed.Client()
    dask.config.set({"distributed.scheduler.allowed-failures": RETRIES})
    return distributed.Client(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        memory_limit=memory,
        dashboard_address="127.0.0.1:0" if has_dashboard() else None,
        set_as_default=False,
    )


def remote_client(address: str | None = None, scheduler_file: Path | None = None) -> Client:
    """A client of a cluster that is there; ValueError: nobody answers there."""
    _, distributed = _dask()
    if scheduler_file is not None and not scheduler_file.is_file():  # Dask would wait for it
        raise ValueError(f"{scheduler_file}: expected the file of a Dask scheduler, found nothing")
    file = None if scheduler_file is None else str(scheduler_file)
    try:
        return distributed.Client(address, scheduler_file=file, timeout="10s", set_as_default=False)
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{address or file}: expected the scheduler of a Dask cluster, got no answer") from error


def _dask() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ImportError("a fleet needs Dask distributed: pip install 'spplanes[fleet]'") from error
    return dask, distributed


def has_dashboard() -> bool:
    """Whether Dask's dashboard can be shown: it needs bokeh."""
    return find_spec("bokeh") is not None


def _gathered(client: Client, futures: Sequence[Any], what: str, progress: Progress | None) -> list[Any]:
    """Results in the order of the futures; FleetError: the cluster is gone."""
    _, distributed = _dask()
    try:
        for done, _ in enumerate(distributed.as_completed(futures, loop=client.loop)):
            if progress is not None:
                progress(what, done + 1, len(futures))
        results: Any = client.gather(list(futures))
        return results
    except (distributed.CancelledError, distributed.comm.CommClosedError) as error:
        raise FleetError(f"the cluster is gone ({type(error).__name__}); what is finished is kept") from error
    except distributed.KilledWorker as error:
        raise FleetError(
            f"a task ended {RETRIES} workers, which may need more memory; what is finished is kept"
        ) from error


@dataclass(frozen=True)
class Order:
    """A mission to be mapped: all that its result depends on."""

    name: str
    """What it is called in the joined map."""
    log: Path
    rig: Rig | None
    config: SlamConfig
    store: Path
    """Folder that keeps finished missions; its path and that of the log are the same on every worker."""
    keep_partial: bool = False

    def key(self) -> str:
        """Content address: by log, rig, configuration and version; OSError: the log cannot be read."""
        rig = None if self.rig is None else json.dumps(self.rig.to_plain())
        what = [fingerprint(self.log), rig, self.config.model_dump(mode="json"), self.keep_partial, __version__]
        return blake2b(json.dumps(what, sort_keys=True).encode(), digest_size=12).hexdigest()


@dataclass(frozen=True, eq=False)
class Mapped:
    """What became of an order."""

    folder: str | None
    """The run's folder; None: the log could not be used."""
    reason: str = ""
    mission: Mission | None = None
    """The mission without its graph, by the name that it has in this fleet."""


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
    folder = order.store / key
    known = _record_in(folder)
    if known is None:
        try:
            _map(order, folder)
        except (ValueError, ImportError, ArchiveError) as error:
            return Mapped(None, " ".join(str(error).split()))
        known = _record_in(folder)
    if known is None:
        raise OSError(f"{folder}: cannot be read back")  # the store is not shared, or full: done again elsewhere
    return Mapped(str(folder), "", replace(known.mission, name=order.name))


def open_mapped(folder: str, name: str) -> FinishedMission:
    """A finished mission of the store, by the name it has in this fleet."""
    finished = FinishedMission.from_bytes((Path(folder) / RECORD_FILE).read_bytes())
    return replace(finished, mission=replace(finished.mission, name=name))


def compare_mapped(first: Mapped, second: Mapped, config: SlamConfig, significance: float) -> Comparison | None:
    """Two missions compared; None where one could not be used."""
    if first.mission is None or second.mission is None:
        return None
    return compare_missions(first.mission, second.mission, config, significance=significance)


def _map(order: Order, folder: Path) -> None:
    log, sensors = load(order.log, order.rig, keep_partial=order.keep_partial)
    sensors = with_shown_errors(log, sensors)
    with scratch_folder(folder) as work:
        made = work / "run"
        source = Source(order.log, order.keep_partial, assumed=tuple(log.assumed))
        with new_run(made, log, sensors, order.config, source, prior=None, overwrite=False) as (slam, *_):
            run = run_slam(log, sensors, order.config, slam=slam)
            finished = FinishedMission.of(order.name, run.slam, sensors)
            conclude(run, made, lambda into: write_run(run, into, title=f"spplanes fleet {order.name}"))
        (made / RECORD_FILE).write_bytes(finished.to_bytes())
        try:
            made.rename(folder)
        except OSError:  # another worker was first, and made the same; or what lies there is of no use
            if _record_in(folder) is None:
                shutil.rmtree(folder, ignore_errors=True)
                made.rename(folder)


def _record_in(folder: Path) -> FinishedMission | None:
    try:
        return FinishedMission.from_bytes((folder / RECORD_FILE).read_bytes())
    except (OSError, RecordError):
        return None
