"""What can be saved of a damaged session: the longest beginning of it that is what was written."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from slam.session._codec import encode
from slam.session.opening import check_session_given, promise, session_path, writing
from slam.session.store import RawScan, Session, SessionDamaged

_SUFFIXES = ("", "-wal", "-shm")


def salvage_session(path: Path | str) -> str:
    """Make a session of the longest valid beginning of a damaged one, in its place; the old one stays beside it.

    Decisions, raw scans and parameters come along. A session without damage is left as it is. Returns a sentence on
    what was wrong and how many keyframes the session has now.

    Raises:
        SessionError: nothing of it can be read, or another process writes it.
    """
    path = session_path(path)
    check_session_given(path)
    damage = _damage_of(path)
    if damage is None:
        with Session.open(path, read_only=True) as session:
            return f"nothing is damaged; {len(session)} keyframes"
    work, kept = path.with_name(path.name + ".salvaged"), path.with_name(path.name + ".damaged")
    with writing(path) as lock:
        try:
            saved = _copy_beginning(path, work)
            for suffix in _SUFFIXES:
                if path.with_name(path.name + suffix).exists():
                    os.replace(path.with_name(path.name + suffix), kept.with_name(kept.name + suffix))
            os.replace(work, path)
            promise(lock, 0)
        finally:
            for suffix in (*_SUFFIXES, "-lock"):
                work.with_name(work.name + suffix).unlink(missing_ok=True)
    return f"{damage}; saved {saved} keyframes; the damaged file is now {kept.name}"


def _damage_of(path: Path) -> str | None:
    try:
        with Session.open(path) as session:
            for _ in session.entries():
                pass
            for index in range(len(session)):
                session.scans(index)
    except SessionDamaged as error:
        return str(error)
    return None


def _copy_beginning(path: Path, target: Path) -> int:
    """Copy keyframes until one is damaged; returns how many there are."""
    with (
        Session.open(path, read_only=True, damaged=True) as old,
        Session.create(target, old.config, rig=old.rig, prior=old.prior, log=old.log) as new,
    ):
        for index in count():
            try:
                keyframe = old.keyframe(index)
            except SessionDamaged:
                break
            scans, decisions = _scans_of(old, index), None
            contents = [(scan.position, None if scan.scan is None else encode(scan.scan)) for scan in scans]
            new.add_keyframe(replace(keyframe, scans=scans), contents)  # type: ignore[arg-type]  # they know as much
            with suppress(SessionDamaged):  # they will be made again
                decisions = old.decisions(index)
            if decisions is None:
                break
            new.add_decisions(index, decisions)
        return len(new)


def _scans_of(session: Session, index: int) -> tuple[RawScan, ...]:
    """Raw scans are beside the point: damaged, they are left out."""
    try:
        return tuple(session.scans(index))
    except SessionDamaged:
        return ()
