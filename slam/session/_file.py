"""The SQLite file of a session: schema, versions, durability, and what SQLite's errors mean."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

#: Marks a SQLite file as a session ("spln"), and the version of the schema below.
APPLICATION_ID = 0x73706C6E
VERSION = 3

_TABLES = """
CREATE TABLE session (key TEXT PRIMARY KEY, data BLOB NOT NULL, digest BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE keyframes (id INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL, data BLOB NOT NULL, digest BLOB NOT NULL);
CREATE TABLE decisions (keyframe INTEGER PRIMARY KEY, data BLOB NOT NULL, digest BLOB NOT NULL);
CREATE TABLE scans (
    keyframe INTEGER NOT NULL, number INTEGER NOT NULL, sensor TEXT NOT NULL, stamp_ns INTEGER NOT NULL,
    position INTEGER, data BLOB, digest BLOB NOT NULL, PRIMARY KEY (keyframe, number)) WITHOUT ROWID;
CREATE TABLE results (key TEXT PRIMARY KEY, data BLOB NOT NULL, digest BLOB NOT NULL) WITHOUT ROWID;
"""

_STORAGE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_NOMEM", "SQLITE_TOOBIG")


class SessionError(ValueError):
    """A session that cannot be used as asked; the sentence names the file and says why."""


class SessionDamaged(SessionError):
    """Bytes of a session are not those that were written; the sentence says what can be saved."""


class StorageError(OSError):
    """The disk refuses: full, or failing. What was acknowledged before is safe."""


def create(path: Path) -> sqlite3.Connection:
    """A new session file with the tables of today, under a name nobody knows yet; to be synced once, when whole."""
    connection = connect(path, read_only=False)
    with translated(path):
        connection.executescript("PRAGMA synchronous = OFF; PRAGMA journal_mode = MEMORY; PRAGMA page_size = 4096;")
        versions = f"PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION};"
        connection.executescript(f"BEGIN; {_TABLES} {versions} COMMIT;")
    return connection


def connect(path: Path, *, read_only: bool) -> sqlite3.Connection:
    """Open a file that may or may not be a session.

    A commit is on the disk, not only on its way there, when it returns: `synchronous = FULL` syncs the journal at every
    commit, so neither a kill nor a power cut loses what was acknowledged.
    """
    mode = "ro" if read_only else "rwc"
    with translated(path):
        connection = sqlite3.connect(
            f"file:{quote(str(path.resolve()))}?mode={mode}", uri=True, isolation_level=None, timeout=5.0
        )
        connection.executescript("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON; PRAGMA synchronous = FULL;")
    return connection


def check_version(path: Path, connection: sqlite3.Connection) -> None:
    """Make sure that it is a session, and one of today's version."""
    with translated(path):
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application != APPLICATION_ID:
        raise SessionError(f"{path}: expected a session, got another SQLite file")
    if version != VERSION:
        other = "a newer" if version > VERSION else "an older"
        raise SessionError(f"{path}: expected a session of version {VERSION}, got {version}; use {other} spplanes")


def fold_journal(connection: sqlite3.Connection) -> bool:
    """Bring all that is in the journal into the file, synced, and make of it a file that needs none.

    The second changes two bytes of the first page and nothing else: no kill parts it, and which of the two a power cut
    leaves is all the same. It neither needs a sync nor a rollback journal, which a kill would leave to the next reader.
    Without a word the journal stays where a reader still holds it; returns whether it is gone.
    """
    connection.execute("PRAGMA busy_timeout = 500")  # the last thing asked of it: not worth a longer wait
    busy, _, _ = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    if not busy:
        connection.execute("PRAGMA synchronous = OFF")
        try:
            connection.execute("PRAGMA journal_mode = MEMORY")
        finally:
            connection.execute("PRAGMA synchronous = FULL")
    return not busy


@contextmanager
def translated(path: Path) -> Iterator[None]:
    """SQLite's errors as ours."""
    try:
        yield
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", None) or ""
        if name.startswith(_STORAGE):
            why = "the disk is full" if name == "SQLITE_FULL" else str(error)
            raise StorageError(f"{path}: cannot be written ({why}); what was recorded before is safe") from error
        if name.startswith("SQLITE_BUSY"):
            raise SessionError(f"{path}: another process is writing it") from error
        if name.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM", "SQLITE_AUTH")):
            raise SessionError(f"{path}: cannot be opened as asked ({error})") from error
        raise SessionDamaged(f"{path}: expected a session, got a damaged or foreign file ({error})") from error


def sync_folder(path: Path) -> None:
    """Let the names in a folder outlive a power cut, where the file system can be told to."""
    with suppress(OSError):  # not every file system knows how
        handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


_SIZE = 16
#: Files up to this are hashed whole; of larger ones this much at either end, bytes.
_WHOLE = 64 << 20


def digest(*parts: bytes | str | int | None) -> bytes:
    """Checksum of a sequence of parts, each with its length, so that no two sequences look the same."""
    state = hashlib.blake2b(digest_size=_SIZE)
    for part in parts:
        data = b"" if part is None else part if isinstance(part, bytes) else str(part).encode()
        state.update(f"{'-' if part is None else len(data)}:".encode())
        state.update(data)
    return state.digest()


def fingerprint(path: Path) -> dict[str, int | str]:
    """Size and checksum of a log: of its files in order of their names, the largest only of their two ends."""
    files = sorted(one for one in path.iterdir() if one.is_file()) if path.is_dir() else [path]
    state, total = hashlib.blake2b(digest_size=_SIZE), 0
    for file in files:
        size = file.stat().st_size
        total += size
        state.update(f"{file.name if path.is_dir() else ''}:{size};".encode())
        with file.open("rb") as stream:
            for start, left in ((0, size),) if size <= 2 * _WHOLE else ((0, _WHOLE), (size - _WHOLE, _WHOLE)):
                stream.seek(start)
                while left > 0 and (block := stream.read(min(left, 1 << 20))):
                    state.update(block)
                    left -= len(block)
    return {"bytes": total, "blake2b": state.hexdigest()}
