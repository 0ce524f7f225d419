"""Bags as rosbags opens them, every kind of damage as one sentence; and the one bag that is kept open."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from slam.errors import KEEPS_THE_REST, LogError, MissingPackageError
from slam.io.packed import damage_told, in_short
from slam.io.rosbags._bounded_unpacking import bound_rosbags
from slam.io.rosbags._messages import definition_of
from slam.io.rosbags._salvaged import SalvagedBag

_BROKEN = "expected a whole bag, got one that cannot be read"
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
    types, stack = get_typestore(Stores.LATEST), ExitStack()
    try:
        reader = AnyReader([path], default_typestore=types)
        if not reader.is2:
            reader.readers = [_ros1_reader(path)]
        stack.enter_context(reader)
    except Exception as error:  # rosbags on damage: errors of its own, of struct, sqlite3, yaml, zstd and others
        inside = _file_of(path)
        wrong_index = isinstance(error, AssertionError)  # rosbags asserts what an index says of its records
        if inside is None or not (keep_partial or wrong_index):
            raise _broken(path, error, inside is not None) from error
        with damage_told(path, _BROKEN):  # topics or types that cannot be made out
            bag, reader = SalvagedBag(inside), AnyReader([inside], default_typestore=types)
            reader.readers, reader.is2 = [bag], not bag.is_ros1  # type: ignore[list-item]  # as one of its own
            stack.enter_context(reader)
        if not (keep_partial or bag.is_whole):
            raise _broken(path, error, True) from error
    with damage_told(path, _BROKEN), stack:
        yield reader


def _file_of(path: Path) -> Path | None:
    """The file that can be read without its index: a ROS 1 bag, an MCAP file, or the only one of a folder."""
    if path.is_dir():
        inside = sorted(path.glob("*.mcap"))
        return inside[0] if len(inside) == 1 else None
    return path if path.suffix in (".bag", ".mcap") else None


def _ros1_reader(path: Path) -> Any:
    """A reader of a ROS 1 bag that looks at the definitions of what is read, and at no others."""
    from rosbags.rosbag1 import Reader

    class Forgiving(Reader):
        def open(self) -> None:
            super().open()
            told = [definition_of(one.msgtype, one.msgdef.data) for one in self.connections]
            self.connections = [one._replace(msgdef=new) for one, new in zip(self.connections, told, strict=True)]

    return Forgiving(path)


def _broken(path: Path, error: Exception, can_be_cut: bool) -> LogError:
    offer = f"; {KEEPS_THE_REST}" if can_be_cut else ""
    return LogError(path, f"{_BROKEN} ({in_short(error)}){offer}")


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
