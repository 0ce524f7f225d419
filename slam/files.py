"""Files and folders for results: refused where one is, and there only when everything in them is written."""

from __future__ import annotations

import glob
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.session.opening import is_unfinished


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place for a file that takes that of `path`, whatever is there, when the block ends well.

    ValueError: `path` is a folder, or lies where nothing can be written.
    """
    if path.is_dir():
        raise ValueError(f"{path}: expected a file to write, got a folder")
    try:
        with scratch_folder(path) as work:
            yield work / path.name
            os.replace(work / path.name, path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror})") from error


@contextmanager
def scratch_folder(out: Path) -> Iterator[Path]:
    """A hidden folder beside `out`, to be moved to its place, gone at the end unless it was. ValueError: none can."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name[:100]}-", dir=out.parent))
    except OSError as error:
        raise ValueError(f"{out}: cannot be made ({error.strerror})") from error
    try:
        work.chmod(0o755)
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def new_folder(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder that appears under its name only when everything in it is written.

    The work happens in a hidden folder beside it; when anything fails, that one goes and `out` is as it was.
    ValueError: `out` exists and may not be overwritten, or the folder it should lie in cannot be written.
    """
    out = Path(out)
    check_free(out, overwrite=overwrite)
    with scratch_folder(out) as work:
        yield work
        replaced = put_in_place(work, out)
    if replaced is not None:
        shutil.rmtree(replaced.parent, ignore_errors=True)


def check_free(out: Path, *, overwrite: bool, reads: Iterable[Path | None] = ()) -> None:
    """Refuse, before any work is done for it, an output folder that exists and may not be overwritten: a ValueError.

    So is one that holds what the work `reads` (None: not given), for who replaced the folder would lose that.
    """
    for given in reads:
        if given is not None and out.is_dir() and given.exists() and given.resolve().is_relative_to(out.resolve()):
            what = "is read" if given.resolve() == out.resolve() else f"holds {given}, which is read"
            raise ValueError(f"{out}: {what}; give another folder for the results")
    if out.exists() and not (overwrite and out.is_dir()):
        hint = "it is not a folder" if not out.is_dir() else "give --overwrite to replace it"
        if is_unfinished(out):
            hint = f"its run is not finished: go on with --resume {out}, or give --overwrite to begin anew"
        raise ValueError(f"{out}: exists already; {hint}")


def put_in_place(work: Path, out: Path) -> Path | None:
    """Rename `work` to `out`; an old folder of that name waits where this says, alone in a hidden one beside it."""
    if not out.exists():
        os.replace(work, out)
        return None
    aside = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent)) / out.name
    os.replace(out, aside)
    try:
        os.replace(work, out)
    except OSError:
        os.replace(aside, out)
        raise
    return aside


def replaced_by(out: Path) -> list[Path]:
    """Old folders that wait since `put_in_place` put others in their place, of runs that were killed as well."""
    # the name inside tells them from those of a folder whose name begins as this one's
    name = glob.escape(out.name)
    return sorted(out.parent.glob(f".{name}-old-*/{name}"))
