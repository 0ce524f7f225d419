"""One writer at a time: a lock that its owner's end, however sudden, releases."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from weakref import WeakSet

#: Locks that this process holds.
_held: WeakSet[WriterLock] = WeakSet()


class WriterLock:
    """An exclusive `flock` on a file beside the session; it goes away with the lock, and after a kill with the next.

    Not on the database itself: closing any handle of that would drop SQLite's own locks in this process.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.with_name(path.name + "-lock")
        self._handle: int | None = None

    def take(self) -> bool:
        """Whether it is ours now.

        Raises:
            OSError: the lock's file cannot be made.
        """
        while True:
            handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                here = os.stat(self._path) if self._path.exists() else None
            except BlockingIOError:
                os.close(handle)
                return False
            if here is not None and here.st_ino == os.fstat(handle).st_ino:
                self._handle = handle
                _held.add(self)
                return True
            os.close(handle)  # its last owner removed the file between our open and our lock

    def is_taken(self) -> bool:
        """Whether somebody holds it."""
        try:
            handle = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
        except BlockingIOError:
            return True
        finally:
            os.close(handle)

    def release(self) -> None:
        """Give it back; without it nothing happens."""
        if self._handle is None:
            return
        self._path.unlink(missing_ok=True)
        self._let_go()

    def _let_go(self) -> None:
        """Close the handle; the lock goes with the last one there is."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None
        _held.discard(self)


def _leave_to_parent() -> None:
    """A process that forks off holds nothing: the lock must end with the one that took it."""
    for lock in list(_held):
        lock._let_go()


os.register_at_fork(after_in_child=_leave_to_parent)
