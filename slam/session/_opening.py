"""How a session's file comes to be there, and how it is opened: one writer, checked before anything is believed."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from slam.session._digest import digest
from slam.session._file import (
    SessionDamaged,
    SessionError,
    StorageError,
    check_structure,
    check_version,
    connect,
    create,
    sync_folder,
    transaction,
    translated,
)
from slam.session._lock import WriterLock
from slam.session._wal import lost_frames, plan_removal


@dataclass(frozen=True)
class OpenFile:
    """A session's file in use."""

    connection: sqlite3.Connection
    """To the database."""
    lock: WriterLock | None
    """The writer's; None: it is only read."""
    version: int
    """Of its schema."""

    def close(self) -> None:
        """Let go of it; twice is once."""
        self.connection.close()
        if self.lock is not None:
            self.lock.release()


def make_file(path: Path, values: Mapping[str, bytes]) -> None:
    """A new session with these parameters: there with all of them, or not there."""
    lock, work = _locked(path), path.with_name(path.name + ".new")
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
        for left in (work, *(work.with_name(work.name + end) for end in ("-wal", "-shm"))):
            left.unlink(missing_ok=True)
        lock.release()


def open_file(path: Path, *, read_only: bool, damaged: bool) -> OpenFile:
    """Open a session; a writer brings it up to today's version. `damaged`: what is broken is known to be."""
    lock = None if read_only else _locked(path)
    connection: sqlite3.Connection | None = None
    try:
        if not damaged:
            _check_journal(path, writer_may_live=read_only)
        if read_only:
            _roll_back(path)
        connection = connect(path, read_only=read_only)
        version = check_version(path, connection, read_only=read_only)
        if not read_only:
            check_structure(path, connection)
            with translated(path):
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("SELECT count(*) FROM session").fetchone()  # from here on there is a journal
            plan_removal(path)
        return OpenFile(connection, lock, version)
    except BaseException:
        if connection is not None:
            connection.close()
        if lock is not None:
            lock.release()
        raise


def put(connection: sqlite3.Connection, table: str, key: str, data: bytes) -> None:
    """Write a named value with its checksum."""
    connection.execute(f"INSERT OR REPLACE INTO {table} VALUES (?, ?, ?)", (key, data, digest(key, data)))


def _locked(path: Path) -> WriterLock:
    lock = WriterLock(path)
    try:
        taken = lock.take()
    except OSError as error:
        raise SessionError(f"{path}: cannot be written ({error.strerror})") from error
    if not taken:
        raise SessionError(f"{path}: another process is writing it")
    return lock


def _roll_back(path: Path) -> None:
    """Undo the last write of a writer that was killed while it closed the session: no reader may, nor can it read.

    Where that cannot be done, on a read-only disk or beside a writer, SQLite says what it needs.
    """
    if not path.with_name(f"{path.name}-journal").exists():
        return
    try:
        lock = _locked(path)
    except SessionError:
        return
    try:
        connect(path, read_only=False).close()
    except (SessionError, OSError):
        return
    finally:
        lock.release()


def _check_journal(path: Path, *, writer_may_live: bool) -> None:
    """Refuse a journal that lost what was acknowledged; one that is just being written is its writer's affair."""
    try:
        if writer_may_live and WriterLock(path).is_taken():
            return
        lost = lost_frames(path)
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
    if lost:
        raise SessionDamaged(f"{path}: damaged; {lost} pages of its journal, the last keyframes, cannot be read")
