"""Work done ahead of whoever wants its results one by one in order: processes that each do every so-manieth part.

What each part comes to depends on nothing but the part, so the results are the same bits however many processes there
are. They are forked: all that the work knows is theirs without being copied, and only results travel. A process waits
as soon as its pipe is full, which bounds the memory. What a process does not give, because the work raised an error
there or the system killed it, is done where it is wanted, as if there were none.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import io
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, Pipe
from typing import Any, NoReturn, TypeVar

from spplanes import _threads

Result = TypeVar("Result")


def cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_parallel_map(
    work: Callable[[int], Result], numbers: range, jobs: int, shared: Sequence[object] = ()
) -> Iterator[Result]:
    """``work(number)`` of every number, in order, by so many processes, or here where there is but one.

    The first is done here: what it reads, compiles and remembers is there for all. Only Linux can fork a process that
    has compiled code and threads; elsewhere all is done here. Closing the iterator ends the processes.

    Args:
        work: told a number and knowing the rest itself; the same wherever it is called.
        numbers: what to do.
        jobs: processes.
        shared: objects that results refer to and do not bring along: they are these very ones again.
    """
    if not numbers:
        return
    yield work(numbers[0])
    rest = numbers[1:]
    count = min(jobs, len(rest)) if sys.platform == "linux" else 1
    if count < 2:
        yield from map(work, rest)
        return
    with contextlib.ExitStack() as ending:
        helpers: list[_Helper] = []
        for first in range(count):
            helpers.append(_Helper(work, rest[first::count], shared, helpers))
            ending.callback(helpers[-1].end)
        for place, number in enumerate(rest):
            given = helpers[place % count].next()
            yield work(number) if given is None else _loads(given, shared)


class _Helper:
    """A process that does its numbers one after another."""

    def __init__(
        self, work: Callable[[int], Any], numbers: range, shared: Sequence[object], others: Sequence[_Helper]
    ) -> None:
        self._results, sending = Pipe(duplex=False)
        parent, self._pid = os.getpid(), os.fork()
        if not self._pid:
            for end in (self._results, *(other._results for other in others)):
                end.close()
            _help(work, numbers, shared, sending, parent)
        sending.close()
        with contextlib.suppress(OSError, AttributeError):  # bytes of some keyframes may wait: all that Linux allows
            fcntl.fcntl(self._results.fileno(), fcntl.F_SETPIPE_SZ, 1 << 20)

    def next(self) -> bytes | None:
        """The next result, pickled; None: it gives no more."""
        try:
            return self._results.recv_bytes()
        except (EOFError, OSError):  # it ended between two results, or in the middle of one
            return None

    def end(self) -> None:
        """No more of it."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._pid, 0)
        self._results.close()


def _help(
    work: Callable[[int], Any], numbers: range, shared: Sequence[object], results: Connection, parent: int
) -> NoReturn:
    """All that a forked process does; it never returns to what it was forked from."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; whoever waits for the results ends this
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: when the one that made it ends
        _threads.stay_alone()
        known = {id(one): place for place, one in enumerate(shared)}
        for number in numbers:
            if os.getppid() != parent:
                break  # it ended before it could be told apart
            results.send_bytes(_dumps(work(number), known))
    except BaseException:  # whoever wants the result does the work, and has the error
        os._exit(1)
    os._exit(0)


def _dumps(result: object, known: dict[int, int]) -> bytes:
    data = io.BytesIO()
    pickler = pickle.Pickler(data, pickle.HIGHEST_PROTOCOL)
    pickler.persistent_id = lambda one: known.get(id(one))  # type: ignore[method-assign]
    pickler.dump(result)
    return data.getvalue()


def _loads(data: bytes, shared: Sequence[object]) -> Any:
    unpickler = pickle.Unpickler(io.BytesIO(data))  # noqa: S301  of a process of our own
    unpickler.persistent_load = shared.__getitem__  # type: ignore[method-assign]
    return unpickler.load()
