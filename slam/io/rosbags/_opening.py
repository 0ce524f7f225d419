"""Bags as rosbags opens them, every kind of damage as one sentence; and the one bag that is kept open."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from slam.errors import KEEPS_THE_REST, LogError, MissingPackageError
from slam.io.packed import in_short
from slam.io.rosbags._bounded_unpacking import bound_rosbags
from slam.io.rosbags._messages import READ, with_todays_header
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
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        if not reader.is2:
            reader.readers = [_ros1_reader(path)]
        stack.enter_context(reader)
    except Exception as error:  # rosbags on damage: errors of its own, of struct, sqlite3, yaml, zstd and others
        inside = _file_of(path)
        wrong_index = isinstance(error, AssertionError)  # rosbags asserts what an index says of its records
        if inside is None or not (keep_partial or wrong_index):
            raise _broken(path, error, inside is not None) from error
        try:
            reader = SalvagedBag(inside)
        except LogError:
            raise
        except Exception as worse:  # topics or types that cannot be made out
            raise _broken(path, worse) from worse
        if not (keep_partial or reader.is_whole):
            raise _broken(path, error, True) from error
        yield reader
        return
    try:
        with stack:
            yield reader
    except LogError:
        raise
    except Exception as error:  # as above
        raise _broken(path, error) from error


def _file_of(path: Path) -> Path | None:
    """The file that can be read without its index: a ROS 1 bag, an MCAP file, or the only one of a folder."""
    if path.is_dir():
        inside = sorted(path.glob("*.mcap"))
        return inside[0] if len(inside) == 1 else None
    return path if path.suffix in (".bag", ".mcap") else None


def _ros1_reader(path: Path) -> Any:
    """A reader of a ROS 1 bag that looks at the definitions of what is read, and at no others.

    Bags of 2010 call the header roslib/Header; it is the same, and rosbags knows the later name alone. What else is in
    a bag may be defined as badly as it likes.
    """
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.rosbag1 import Reader

    class Forgiving(Reader):
        def open(self) -> None:
            super().open()
            self.connections = [one._replace(msgdef=told_of(one)) for one in self.connections]

    def told_of(connection: Any) -> Any:
        if connection.msgtype not in READ:
            return MessageDefinition(MessageDefinitionFormat.NONE, "")
        return connection.msgdef._replace(data=with_todays_header(connection.msgdef.data))

    return Forgiving(path)


def _broken(path: Path, error: Exception, can_be_cut: bool = False) -> LogError:
    offer = f"; {KEEPS_THE_REST}" if can_be_cut else ""
    return LogError(path, f"expected a whole bag, got one that cannot be read ({in_short(error)}){offer}")


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
