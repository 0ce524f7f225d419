"""Whether a run came to its end: asked of its session alone, without reading what was measured."""

from __future__ import annotations

import json
from pathlib import Path

from slam.session._file import SessionError, digest, translated
from slam.session._opening import open_file

#: Name of the session in the folder of a run.
SESSION_FILE = "session.db"


def session_path(path: Path | str) -> Path:
    """The session file: the path itself, or session.db in the folder of a run."""
    path = Path(path)
    return path / SESSION_FILE if path.is_dir() else path


def check_session_given(path: Path) -> None:
    """SessionError: no file is there."""
    if not path.is_file():
        raise SessionError(f"{path}: expected a session, found nothing")


def is_unfinished(folder: Path | str) -> bool:
    """Whether a folder holds a run that was interrupted, or that goes on now; in doubt it does not."""
    path = Path(folder) / SESSION_FILE
    if not path.is_file():
        return False
    try:
        file = open_file(path, read_only=True, damaged=False)
        with file.opened, translated(path):
            row = file.connection.execute("SELECT data, digest FROM session WHERE key = 'state'").fetchone()
        return digest("state", row[0]) == row[1] and json.loads(row[0])["state"] != "finished"
    except (ValueError, OSError, KeyError, TypeError):
        return False


def check_finished(folder: Path | str) -> None:
    """SessionError: a folder holds a run that has no results yet; the sentence says how it gets them."""
    if not (Path(folder) / "planes.json").is_file() and is_unfinished(folder):
        raise SessionError(f"{folder}: the run is not finished; go on with: spplanes slam --resume {folder}")
