"""Bags as rosbags opens them, every kind of damage as one sentence; and the one bag that is kept open."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from slam.errors import KEEPS_THE_REST, LogError, MissingPackageError
from slam.io.rosbags._bounded_unpacking import bound_rosbags
from slam.io.rosbags._salvaged import SalvagedBag

#: The bag that clouds were last taken from: to open one anew for each cloud would take most of the time.
_kept: dict[tuple[Path, bool, int, int], tuple[ExitStack, Any]] = {}
_inherited: dict[tuple[Path, bool, int, int], tuple[ExitStack, Any]] = {}


@contextmanager
def opened(path: Path, keep_partial: bool = False) -> Iterator[Any]:
    """The bag as rosbags reads it, or what can be salvaged of it; whatever is made of a damaged one is one sentence."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingPackageError(path, "rosbags", "ros") from error
    bound_rosbags()
    if path.is_file() and path.stat().st_size == 0:
        raise LogError(path, "expected a bag, got an empty file")
    try:
        stack = ExitStack()
        reader = stack.enter_context(AnyReader([path], default_typestore=get_typestore(Stores.LATEST)))
    except Exception as error:  # rosbags on damage: errors of its own, of struct, sqlite3, yaml, zstd and others
        can_be_cut = path.suffix in (".bag", ".mcap")
        if not (keep_partial and can_be_cut):
            raise _broken(path, error, can_be_cut) from error
        try:
            reader = SalvagedBag(path)
        except LogError:
            raise
        except Exception as worse:  # topics or types that cannot be made out
            raise _broken(path, worse) from worse
        yield reader
        return
    try:
        with stack:
            yield reader
    except LogError:
        raise
    except Exception as error:  # as above
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception, can_be_cut: bool = False) -> LogError:
    offer = f"; {KEEPS_THE_REST}" if can_be_cut else ""
    return LogError(path, f"expected a whole bag, got one that cannot be read ({in_short(error)}){offer}")


def in_short(error: Exception) -> str:
    """What an error says, on one line."""
    return " ".join(str(error).split())[:100] or type(error).__name__


def kept_open(path: Path, keep_partial: bool) -> Any:
    """The bag, opened unless it is the one that was opened last."""
    status = path.stat()
    key = (path, keep_partial, status.st_mtime_ns, status.st_size)
    if key not in _kept:
        _close_kept()
        stack = ExitStack()
        _kept[key] = stack, stack.enter_context(opened(path, keep_partial))
    return _kept[key][1]


def _leave_to_parent() -> None:
    """A process that forks off opens the bag anew: where reading goes on would be shared. It closes nothing."""
    _inherited.update(_kept)
    _kept.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


@atexit.register
def _close_kept() -> None:
    for stack, _ in _kept.values():
        stack.close()
    _kept.clear()
