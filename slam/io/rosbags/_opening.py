"""Bags as rosbags opens them, every kind of damage as one sentence; and the one bag that is kept open."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from slam.errors import KEEPS_THE_REST, LogError, MissingPackageError
from slam.io import raw
from slam.io.raw import TooLarge, damage_told, in_short, unpack
from slam.io.rosbags._messages import definition_of
from slam.io.rosbags._salvaged import SalvagedBag

_BROKEN = "expected a whole bag, got one that cannot be read"
#: The bag that clouds were last taken from: to open one anew for each cloud would take most of the time.
_kept: dict[tuple[Path, bool, int, int, int], tuple[ExitStack, Any]] = {}


@contextmanager
def opened(path: Path, keep_partial: bool = False) -> Iterator[Any]:
    """The bag as rosbags reads it, or what can be salvaged of it; whatever is made of a damaged one is one sentence."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingPackageError(path, "rosbags", "ros") from error
    _bound_rosbags()
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


@cache
def _bound_rosbags() -> None:
    """Let rosbags unpack with `unpack`, from now on.

    It unpacks whatever a chunk becomes before it looks at the size that the chunk states, which may be a lie as well.
    """
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    for kind in ("bz2", "lz4"):
        rosbag1.decompressors[kind] = lambda data, kind=kind: unpack(data, kind)
    for kind in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[kind] = lambda data, _, kind=kind: unpack(data, kind)
    whole: Any = rosbag2.zstd

    @contextmanager
    def bounded(file: BinaryIO, mode: str) -> Iterator[SimpleNamespace]:
        left = max(raw.HARMLESS_BYTES, raw.MOST_GROWTH * os.fstat(file.fileno()).st_size)

        def read(size: int) -> bytes:
            nonlocal left
            data = unpacked.read(size)
            left -= len(data)
            if left < 0:
                raise TooLarge("expected sensor data, got a packed file that grows out of all proportion")
            return data

        with whole.open(file, mode) as unpacked:
            yield SimpleNamespace(read=read)

    # all it has of the module: for compressed messages, and for compressed files
    rosbag2.zstd = SimpleNamespace(decompress=lambda data: unpack(data, "zstd"), open=bounded)  # type: ignore[assignment]


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
            told = [definition_of(connection.msgtype, connection.msgdef.data) for connection in self.connections]
            self.connections = [
                connection._replace(msgdef=new) for connection, new in zip(self.connections, told, strict=True)
            ]

    return Forgiving(path)


def _broken(path: Path, error: Exception, can_be_cut: bool) -> LogError:
    offer = f"; {KEEPS_THE_REST}" if can_be_cut else ""
    return LogError(path, f"{_BROKEN} ({in_short(error)}){offer}")


def kept_open(path: Path, keep_partial: bool) -> Any:
    """The bag, opened unless it is the one that this process opened last: where reading goes on is shared by a fork."""
    status = path.stat()
    key = (path, keep_partial, status.st_mtime_ns, status.st_size, os.getpid())
    if key not in _kept:
        _close_kept()
        stack = ExitStack()
        _kept[key] = stack, stack.enter_context(opened(path, keep_partial))
    return _kept[key][1]


@atexit.register
def _close_kept() -> None:
    """Close the bag that this process opened; what it has by a fork is its parent's to close."""
    for key in [key for key in _kept if key[-1] == os.getpid()]:
        _kept.pop(key)[0].close()
