"""A fleet of missions on Dask: every log a task, every pair of missions a task, one map at the end."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam.config import SlamConfig
from slam.fleet.tasks import Order, compare_records, map_log, open_mapped
from slam.joining.join import SIGNIFICANCE, joined_by, names_of
from slam.joining.joined_map import JoinedMap
from slam.joining.records import comparison_from_bytes
from slam.sensors.rig import Rig
from slam.session.store import rig_json

if TYPE_CHECKING:
    from distributed import Client

Progress = Callable[[str, int, int], None]

#: A task is tried again so often when its worker is killed or the store fails it.
RETRIES = 10

#: So long is waited for a scheduler to answer.
_PATIENCE_S = "10s"


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

    Every log is one task, every pair of missions another; the joint solution is made here. What travels are records of
    numbers. Finished missions are kept in the store by their content (log, rig, configuration, version) and never
    mapped again: a fleet that was killed goes on by being run again.

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
    if len(logs) < 2:
        raise ValueError(f"logs: expected at least two, got {len(logs)}")
    if not 0.0 < significance < 0.5:
        raise ValueError(f"significance: expected a probability in (0, 0.5), got {significance}")
    config = config or SlamConfig()
    settings = json.dumps(config.model_dump(mode="json"))
    sensors = None if rig is None else rig_json(rig).decode()
    where = str(Path(store).resolve())
    orders = [
        Order(name, str(Path(log).resolve()), sensors, settings, where, keep_partial)
        for name, log in zip(names_of(logs), logs, strict=True)
    ]
    with local_client() if client is None else nullcontext(client) as used:
        return _on(used, orders, config, settings, significance, strict, progress)


def local_client(workers: int | None = None, memory: str = "auto") -> Client:
    """A client of the cluster that Dask's configuration names, else of processes on this machine.

    Args:
        workers: processes, of one thread each; None: one for each core.
        memory: that each may take, as Dask says it ("4GB"); "auto": its share of the machine's. A worker that goes
            beyond is ended and its tasks are done again elsewhere.

    Raises:
        ImportError: without Dask distributed.
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
    """A client of a cluster that is there.

    Raises:
        ImportError: without Dask distributed.
        ValueError: nobody answers there.
    """
    _, distributed = _dask()
    try:
        if scheduler_file is not None:
            if not scheduler_file.is_file():  # Dask would wait for it
                raise ValueError(f"{scheduler_file}: expected the file of a Dask scheduler, found nothing")
            return distributed.Client(scheduler_file=str(scheduler_file), timeout=_PATIENCE_S, set_as_default=False)
        return distributed.Client(address, timeout=_PATIENCE_S, set_as_default=False)
    except (OSError, json.JSONDecodeError) as error:
        where = address or scheduler_file
        raise ValueError(f"{where}: expected the scheduler of a Dask cluster, got no answer") from error


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


def _on(
    client: Client,
    orders: Sequence[Order],
    config: SlamConfig,
    settings: str,
    significance: float,
    strict: bool,
    progress: Progress | None,
) -> JoinedMap:
    pairs = list(combinations(range(len(orders)), 2))
    mapped = [client.submit(map_log, one, pure=True, retries=RETRIES) for one in orders]
    compared = [
        client.submit(
            compare_records,
            mapped[a],
            mapped[b],
            (orders[a].name, orders[b].name),
            settings,
            significance / len(pairs),
            pure=True,
            retries=RETRIES,
        )
        for a, b in pairs
    ]
    names, results = [order.name for order in orders], _gathered(client, mapped, "missions", progress)
    left_out = {name: one.reason for name, one in zip(names, results, strict=True) if one.folder is None}
    if left_out and (strict or len(left_out) == len(orders)):
        name, reason = next(iter(left_out.items()))
        raise ValueError(f"logs: expected ones that can be mapped, got {len(left_out)} that cannot ({name}: {reason})")
    records = [one for one in _gathered(client, compared, "pairs", progress) if one is not None]
    folders = {name: one.folder for name, one in zip(names, results, strict=True) if one.folder is not None}
    missions = {name: open_mapped(folder, name) for name, folder in folders.items()}
    joined = joined_by(missions, [comparison_from_bytes(one) for one in records], config, left_out)
    return replace(joined, folders=folders)


def _gathered(client: Client, futures: Sequence[Any], what: str, progress: Progress | None) -> list[Any]:
    """Results in the order of the futures.

    Raises:
        FleetError: the cluster is gone.
    """
    _, distributed = _dask()
    try:
        for done, _ in enumerate(distributed.as_completed(futures, loop=client.loop)):
            if progress is not None:
                progress(what, done + 1, len(futures))
        results: Any = client.gather(list(futures))
        return results
    except (
        distributed.CancelledError,
        distributed.client.FutureCancelledError,
        distributed.comm.CommClosedError,
    ) as error:
        raise FleetError(f"the cluster is gone ({type(error).__name__}); what is finished is kept") from error
    except distributed.KilledWorker as error:
        raise FleetError(
            f"a task ended {RETRIES} workers, which may need more memory; what is finished is kept"
        ) from error
