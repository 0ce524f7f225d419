"""What a caller gives, refused where nothing is of that name: asked before anything that takes long is imported."""

from __future__ import annotations

import os
from pathlib import Path

from slam.errors import LogError

#: Simulated worlds (`slam.simulation`).
WORLDS = ("corridor", "office", "room", "hall")


def check_world_given(world: str) -> None:
    """Refuse a name that is none of `WORLDS`.

    Raises:
        ValueError: so it is.
    """
    if world not in WORLDS:
        raise ValueError(f"world: expected one of {', '.join(WORLDS)}, got {world!r}")


def check_log_given(path: Path) -> None:
    """Refuse a log where nothing is.

    Raises:
        LogError: so it is.
    """
    if not path.exists():
        raise LogError(path, "expected a log file or a folder of scans, found nothing")


def check_cloud_given(path: Path) -> None:
    """Refuse a cloud where no file is.

    Raises:
        LogError: so it is.
    """
    if not path.is_file():
        raise LogError(path, "expected a file with a cloud, found none")


def check_run_given(folder: Path) -> None:
    """Refuse a folder without the planes of a run.

    Raises:
        LogError: so it is.
    """
    if not (folder / "planes.json").is_file():
        raise LogError(folder, "expected the folder of a run, found no planes.json in it")


def check_folder_given(folder: Path) -> None:
    """Refuse the folder of a run where no folder is.

    Raises:
        LogError: so it is.
    """
    if not folder.is_dir():
        raise LogError(folder, f"expected the folder of a run, found {'a file' if folder.exists() else 'nothing'}")


def check_truth_given(path: Path) -> None:
    """Refuse a truth where nothing is.

    Raises:
        LogError: so it is.
    """
    if not path.exists():
        raise LogError(path, "expected a mission's folder, a trajectory or a file of relations, got nothing")


def check_file_given(path: Path) -> None:
    """Refuse a file that cannot be opened to be read.

    Raises:
        LogError: so it is, and why.
    """
    try:
        os.close(os.open(path, os.O_RDONLY))
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
