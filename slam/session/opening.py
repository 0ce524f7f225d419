"""How a session's file comes to be there, is opened (one writer, checked first), and whether its run ended."""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from slam.errors import LogError
from slam.session._file import (
    SessionDamaged,
    SessionError,
    StorageError,
    check_version,
    connect,
    create,
    digest,
    sync_folder,
    translated,
)

#: Name of the session in the folder of a run.
SESSION_FILE = "session.db"
#: What the name of its lock ends with.
_LOCK = "-lock"
#: Room for the pages after which SQLite folds the journal back into the file, bytes, with their heads.
_ROOM = 32 + 1100 * (24 + 4096)


def preallocate_journal(path: Path) -> None:
    """Fill the journal up with zeros to the size it will come to, as far as the disk has room for them.

    To sync a file that grows takes the file system a commit of its own: measured, 4 ms instead of 0.1 ms. SQLite takes
    zeros behind its last frame for the end of the journal, which they are.
    """
    journal = path.with_name(path.name + "-wal")
    with suppress(OSError), journal.open("r+b", buffering=0) as file:  # else there is none to be made larger
        size = file.seek(0, os.SEEK_END)
        room, written = max(_ROOM - size, 0), 0
        with suppress(OSError):
            written = file.write(bytes(room))
        if written < room:
            file.truncate(size)
        os.fsync(file.fileno())


#: Handles of the locks that this process holds.
_held: set[int] = set()


@contextmanager
def writing(path: Path) -> Iterator[int]:
    """Be the writer: an exclusive `flock` on a file beside the session, which goes away at the end; gives its handle.

    After a kill the next writer finds it free. Not on the database itself: closing any handle of that would drop
    SQLite's own locks in this process. The file holds what was promised (`promise`), and stays while it does. Where
    somebody else is, or the lock's file cannot be made, that is a SessionError.
    """
    lock, process = path.with_name(path.name + _LOCK), os.getpid()
    try:
        handle = _locked(lock)
    except BlockingIOError as error:
        raise SessionError(f"{path}: another process is writing it") from error
    except OSError as error:
        raise SessionError(f"{path}: cannot be written ({error.strerror})") from error
    _held.add(handle)
    try:
        yield handle
    finally:
        if os.getpid() == process:  # one that was forked off holds nothing
            if not os.fstat(handle).st_size:
                lock.unlink(missing_ok=True)
            _held.discard(handle)
            os.close(handle)


def promise(lock: int, keyframes: int) -> None:
    """Remember beside the session how many keyframes were committed; 0: what it says itself is all there is to know.

    SQLite reads a journal that was cut off or damaged as far as it can, without a word.
    """
    if lock not in _held:
        return  # this process was forked off: by now the handle may be of any file
    with suppress(OSError):  # the disk is full: committed they are
        if keyframes:
            os.pwrite(lock, keyframes.to_bytes(8, "little"), 0)
        else:
            os.ftruncate(lock, 0)


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


def _leave_to_parent() -> None:
    """A process that forks off holds nothing: the lock must end with the one that took it."""
    while _held:
        os.close(_held.pop())


os.register_at_fork(after_in_child=_leave_to_parent)


class OpenFile(NamedTuple):
    """A session's file in use: its connection, the writer's lock (None: only read), and what lets go of both."""

    connection: sqlite3.Connection
    lock: int | None
    opened: ExitStack


def make_file(path: Path, values: Mapping[str, bytes]) -> None:
    """A new session with these parameters: there with all of them, or not there."""
    work = path.with_name(path.name + ".new")
    with writing(path) as lock:
        promise(lock, 0)
        try:
            work.unlink(missing_ok=True)
            with closing(create(work)) as made, translated(work):
                for key, value in values.items():
                    put(made, "session", key, value)
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
        lock = None if read_only else opened.enter_context(writing(path))
        if read_only:
            _roll_back(path)
        if not damaged:
            _check_promise(path)
        connection = opened.enter_context(closing(connect(path, read_only=read_only)))
        check_version(path, connection)
        if not read_only:
            with translated(path):
                problem = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
                if problem != "ok":  # never write into a file that is broken
                    raise SessionDamaged(f"{path}: damaged ({' '.join(problem.split())[:120]})")
                connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("SELECT count(*) FROM session").fetchone()  # from here on there is a journal
            preallocate_journal(path)
        return OpenFile(connection, lock, opened.pop_all())


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


def _check_promise(path: Path) -> None:
    """Refuse a session without keyframes that were committed: a writer that comes to open it would forget them."""
    try:
        promised = int.from_bytes(path.with_name(path.name + _LOCK).read_bytes()[:8], "little")
    except FileNotFoundError:
        return
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror})") from error
    if not promised:
        return
    with closing(connect(path, read_only=True)) as connection, translated(path):
        lost = promised - connection.execute("SELECT count(*) FROM keyframes").fetchone()[0]
    if lost > 0:
        raise SessionDamaged(f"{path}: damaged; {lost} keyframes, the last of its journal, cannot be read")


def session_path(path: Path | str) -> Path:
    """The session file: the path itself, or session.db in the folder of a run."""
    path = Path(path)
    return path / SESSION_FILE if path.is_dir() else path


def given_session(path: Path | str) -> Path:
    """The session file; SessionError: it is not there."""
    path = session_path(path)
    if not path.is_file():
        raise SessionError(f"{path}: expected a session, found nothing")
    return path


def is_unfinished(folder: Path) -> bool:
    """Whether a folder holds a run that was interrupted, or that goes on now; in doubt it does not."""
    path = folder / SESSION_FILE
    if not path.is_file():
        return False
    try:
        file = open_file(path, read_only=True, damaged=False)
        with file.opened, translated(path):
            row = file.connection.execute("SELECT data, digest FROM session WHERE key = 'state'").fetchone()
        return digest("state", row[0]) == row[1] and json.loads(row[0])["state"] != "finished"
    except (ValueError, OSError, KeyError, TypeError):
        return False


def check_finished(folder: Path) -> None:
    """SessionError: a folder holds a run that has no results yet; the sentence says how it gets them."""
    if not (folder / "planes.json").is_file() and is_unfinished(folder):
        raise SessionError(f"{folder}: the run is not finished; go on with: spplanes slam --resume {folder}")


def check_run_given(folder: Path) -> None:
    """SessionError: the run in a folder is not finished; LogError: the folder has no planes of one."""
    check_finished(folder)
    if not (folder / "planes.json").is_file():
        raise LogError(folder, "expected the folder of a run, found no planes.json in it")
