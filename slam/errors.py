"""Errors that name a file, and what a caller gives refused where nothing is of that name, before long imports."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any

#: Simulated worlds (`slam.simulation`).
WORLDS = ("corridor", "office", "room", "hall")
#: What the sentence on a log that breaks off ends with, where the part before can be used.
KEEPS_THE_REST = "--keep-partial uses what comes before"


class LogError(ValueError):
    """A file that cannot be read as what it claims to be; the sentence names the file, and the line if there is one."""

    def __init__(self, path: Path | str, problem: str, *, line: int | None = None) -> None:
        where = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {problem}")
        self.path, self.line, self.problem = Path(path), line, problem


class MissingPackageError(LogError, ImportError):  # type: ignore[misc]  # both have a path
    """A format whose reader or writer needs a package that is not installed; the sentence says what to install."""

    def __init__(self, path: Path | str, package: str, extra: str, *, doing: str = "reading") -> None:
        super().__init__(path, f"{doing} this needs {package}: pip install 'spplanes[{extra}]'")


def optional(name: str, and_so: str = "") -> Any:
    """A package of an extra of its own name, where no file is read or written; ImportError: what to install."""
    try:
        return import_module(name)
    except (ImportError, OSError) as error:
        hint = f"install it with `pip install spplanes[{name}]`{and_so}"
        raise ImportError(f"{name} cannot be imported; {hint}: {error}") from error


def check_world_given(world: str) -> None:
    """ValueError: a name that is none of `WORLDS`."""
    if world not in WORLDS:
        raise ValueError(f"world: expected one of {', '.join(WORLDS)}, got {world!r}")


def check_log_given(path: Path) -> None:
    """LogError: nothing is there."""
    if not path.exists():
        raise LogError(path, "expected a log file or a folder of scans, found nothing")


def check_cloud_given(path: Path) -> None:
    """LogError: no file is there."""
    if not path.is_file():
        raise LogError(path, "expected a file with a cloud, found none")


def check_folder_given(folder: Path) -> None:
    """LogError: no folder is there."""
    if not folder.is_dir():
        raise LogError(folder, f"expected the folder of a run, found {'a file' if folder.exists() else 'nothing'}")


def check_truth_given(path: Path) -> None:
    """LogError: nothing is there."""
    if not path.exists():
        raise LogError(path, "expected a mission's folder, a trajectory or a file of relations, got nothing")


def cannot_be_read(path: Path, error: OSError) -> LogError:
    """What to raise of a file that the system does not open or read."""
    return LogError(path, f"cannot be read: {error.strerror or error}")


def check_file_given(path: Path) -> None:
    """LogError: it cannot be opened to be read, and why."""
    try:
        os.close(os.open(path, os.O_RDONLY))
    except OSError as error:
        raise cannot_be_read(path, error) from error
