"""How a session's file comes to be there, and how it is opened: one writer, checked before anything is believed."""

from __future__ import annotations

import fcntl
import os
import sqlite3
import struct
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from slam.session._file import (
    SessionDamaged,
    SessionError,
    StorageError,
    check_structure,
    check_version,
    connect,
    create,
    digest,
    sync_folder,
    transaction,
    translated,
)

_HEADER, _FRAME = 32, 24
#: Room for the pages after which SQLite folds the journal back into the file, bytes.
_ROOM = _HEADER + 1100 * (_FRAME + 4096)
_MAGIC = (0x377F0682, 0x377F0683)


def preallocate_journal(path: Path) -> None:
    """Fill the journal up with zeros to the size it will come to, as far as the disk has room for them.

    To sync a file that grows takes the file system a commit of its own: measured, 4 ms instead of 0.1 ms. SQLite takes
    zeros behind its last frame for the end of the journal, which they are.
    """
    journal = path.with_name(path.name + "-wal")
    with suppress(OSError), journal.open("r+b", buffering=0) as file:  # else there is none to be made larger
        size = file.seek(0, os.SEEK_END)
        room = max(_ROOM - size, 0)
        try:
            enough = file.write(bytes(room)) == room
        except OSError:
            enough = False
        if not enough:
            file.truncate(size)
        os.fsync(file.fileno())


def lost_frames(path: Path) -> int:
    """How many journal frames of a session that nobody has open were acknowledged and cannot be read; 0: all is well.

    An OSError where the files cannot be read.
    """
    journal = path.with_name(path.name + "-wal")
    data = journal.read_bytes() if journal.is_file() else b""
    if not any(data[:_HEADER]) or len(data) < _HEADER:  # nothing but room, as before the first commit
        return _promised(path, None) or 0
    magic, _, page = struct.unpack_from(">III", data)
    order, salts = (">" if magic & 1 else "<"), data[16:24]
    page = 65536 if page == 1 else page
    sums = _checksum(data[:24], order, 0, 0)
    if magic not in _MAGIC or not 512 <= page <= 65536 or sums != struct.unpack_from(">II", data, 24):
        return max((len(data) - _HEADER) // (_FRAME + 4096), 1)
    valid = committed = last = 0
    for number, start in enumerate(range(_HEADER, len(data) - _FRAME - page + 1, _FRAME + page), 1):
        head, content = data[start : start + _FRAME], data[start + _FRAME : start + _FRAME + page]
        if head[8:16] != salts:
            continue  # of a journal before this one, or room that was made beforehand
        last = number
        if valid == number - 1:
            sums = _checksum(head[:8] + content, order, *sums)
            if sums == struct.unpack_from(">II", head, 16):
                valid = number
                committed = number if any(head[4:8]) else committed
    promised = _promised(path, salts)
    if promised is not None:  # what is behind it was begun and never committed: a kill, or a disk that was full
        return max(promised - committed, 0)
    return max(last - valid, 0)


def _promised(path: Path, salts: bytes | None) -> int | None:
    """Frames that the index beside the journal says were committed; None: there is none of the same generation."""
    index = path.with_name(path.name + "-shm")
    data = index.read_bytes()[:96] if index.is_file() else b""
    if len(data) < 96 or data[:48] != data[48:] or not data[12] or (salts is not None and data[32:40] != salts):
        return None
    return struct.unpack_from("=I", data, 16)[0]


def _checksum(data: bytes, order: str, first: int, second: int) -> tuple[int, int]:
    """SQLite's checksum of words of 32 bits in an order ("<" or ">"), going on from that of what is before them."""
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) & 0xFFFFFFFF
        second = (second + odd + first) & 0xFFFFFFFF
    return first, second


#: Handles of the locks that this process holds.
_held: set[int] = set()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Be the writer: an exclusive `flock` on a file beside the session, which goes away at the end.

    After a kill the next writer finds it free. Not on the database itself: closing any handle of that would drop
    SQLite's own locks in this process.

    Raises:
        SessionError: somebody else is, or the lock's file cannot be made.
    """
    lock, process = _lock_of(path), os.getpid()
    try:
        handle = _locked(lock)
    except BlockingIOError as error:
        raise SessionError(f"{path}: another process is writing it") from error
    except OSError as error:
        raise SessionError(f"{path}: cannot be written ({error.strerror})") from error
    _held.add(handle)
    try:
        yield
    finally:
        if os.getpid() == process:  # one that was forked off holds nothing
            lock.unlink(missing_ok=True)
            _held.discard(handle)
            os.close(handle)


def _lock_of(path: Path) -> Path:
    return path.with_name(path.name + "-lock")


def _locked(lock: Path) -> int:
    """Handle of a lock that is ours now; a BlockingIOError where somebody holds it."""
    while True:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if lock.exists() and os.path.samestat(os.stat(lock), os.fstat(handle)):
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its last owner removed the file between our open and our lock


def _is_written(path: Path) -> bool:
    """Whether somebody holds the writer's lock."""
    try:
        handle = os.open(_lock_of(path), os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(handle)


def _leave_to_parent() -> None:
    """A process that forks off holds nothing: the lock must end with the one that took it."""
    while _held:
        os.close(_held.pop())


os.register_at_fork(after_in_child=_leave_to_parent)


@dataclass(frozen=True)
class OpenFile:
    """A session's file in use."""

    connection: sqlite3.Connection
    """To the database."""
    read_only: bool
    """Whether it is only read; else the writer's lock is held."""
    opened: ExitStack
    """What lets go of both; twice is once."""


def make_file(path: Path, values: Mapping[str, bytes]) -> None:
    """A new session with these parameters: there with all of them, or not there."""
    work = path.with_name(path.name + ".new")
    with writing(path):
        try:
            work.unlink(missing_ok=True)
            with closing(create(work)) as made:
                with transaction(work, made):
                    for key, value in values.items():
                        put(made, "session", key, value)
                with translated(work):
                    made.execute("PRAGMA journal_mode = WAL")
            with work.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(work, path)
            sync_folder(path.parent)
        except StorageError:
            raise
        except OSError as error:
            raise StorageError(f"{path}: cannot be written ({error.strerror or error})") from error
        finally:
            for suffix in ("", "-wal", "-shm"):
                work.with_name(work.name + suffix).unlink(missing_ok=True)


def open_file(path: Path, *, read_only: bool, damaged: bool) -> OpenFile:
    """Open a session. `damaged`: what is broken is known to be."""
    with ExitStack() as opened:
        if not read_only:
            opened.enter_context(writing(path))
        if not damaged:
            _check_journal(path, writer_may_live=read_only)
        if read_only:
            _roll_back(path)
        connection = opened.enter_context(closing(connect(path, read_only=read_only)))
        check_version(path, connection)
        if not read_only:
            check_structure(path, connection)
            with translated(path):
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("SELECT count(*) FROM session").fetchone()  # from here on there is a journal
            preallocate_journal(path)
        return OpenFile(connection, read_only, opened.pop_all())


def put(connection: sqlite3.Connection, table: str, key: str, data: bytes) -> None:
    """Write a named value with its checksum."""
    connection.execute(f"INSERT OR REPLACE INTO {table} VALUES (?, ?, ?)", (key, data, digest(key, data)))


def _roll_back(path: Path) -> None:
    """Undo the last write of a writer that was killed while it closed the session: no reader may, nor can it read.

    Where that cannot be done, on a read-only disk or beside a writer, SQLite says what it needs.
    """
    if path.with_name(f"{path.name}-journal").exists():
        with suppress(SessionError, OSError), writing(path):
            connect(path, read_only=False).close()


def _check_journal(path: Path, *, writer_may_live: bool) -> None:
    """Refuse a journal that lost what was acknowledged; one that is just being written is its writer's affair."""
    try:
        if writer_may_live and _is_written(path):
            return
        lost = lost_frames(path)
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
    if lost:
        raise SessionDamaged(f"{path}: damaged; {lost} pages of its journal, the last keyframes, cannot be read")
