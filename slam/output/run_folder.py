"""The folder of a run with its session in it: there from the first keyframe on, complete when the session says so."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slam.backend.estimator import BackendError
from slam.config import SlamConfig
from slam.errors import check_folder_given
from slam.files import check_free, put_in_place, replaced_by, scratch_folder
from slam.frontend.keyframes import keyframes_of
from slam.io.load import load
from slam.planeslam import PlaneSlam
from slam.runs.slam_run import Run
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from slam.session._file import fingerprint, sync_folder
from slam.session.opening import SESSION_FILE
from slam.session.prior_map import PriorMap, finished_map
from slam.session.replay import RawScans, SessionRecorder, is_measured_again, resumed
from slam.session.store import Session, SessionError

_WORK = ".results-"
#: What was mended at the end of a run, among the results in its session: nothing is left to mend.
_REPAIRS = "repairs"


@dataclass(frozen=True)
class Source:
    """Where the data of a run come from, and what is kept of them."""

    path: Path
    keep_partial: bool = False
    raw: RawScans = "reference"
    """Whether the session keeps the raw scans themselves, or where they are."""
    forget_raw: bool = False
    """Whether measurements stay on the disk alone while the run goes on."""
    odometry: Path | None = None
    """File that the odometry is taken from; None: the log's own."""
    assumed: tuple[str, ...] = ()
    """What was taken for granted because nobody said it, one sentence each."""

    def as_json(self) -> dict[str, Any]:
        """For the session, with the fingerprints of the log and of the odometry."""
        options = {"keep_partial": self.keep_partial, "raw": self.raw, "forget_raw": self.forget_raw}
        odometry = None if self.odometry is None else _file_as_json(self.odometry)
        return {**options, "odometry": odometry, "assumed": list(self.assumed), **_file_as_json(self.path)}

    @classmethod
    def of(cls, session: Session, moved_to: Path | None = None) -> Source:
        """The source of a session, at its old path or at a new one."""
        known = session.log
        if known is None:
            raise SessionError(f"{session.path}: expected the session of a log, got one that was fed by a program")
        path, options = moved_to or Path(known["path"]), (known["keep_partial"], known["raw"], known["forget_raw"])
        odometry = known.get("odometry")  # sessions of earlier versions have none
        return cls(path, *options, odometry and Path(odometry["path"]), tuple(known.get("assumed", ())))


def _file_as_json(path: Path) -> dict[str, Any]:
    try:
        return {"path": str(path.resolve()), **fingerprint(path)}
    except OSError as error:
        raise SessionError(f"{path}: cannot be read ({error.strerror})") from error


class FinishedAlready(SessionError):
    """A run that came to its end: its results are in its folder."""


@contextmanager
def new_run(
    out: Path, log: Log, rig: Rig, config: SlamConfig, source: Source, *, prior: PriorMap | None, overwrite: bool
) -> Iterator[tuple[PlaneSlam, Log, Rig]]:
    """An estimator that records into the new folder `out`, and what it is to be given: as of a `resumed_run`.

    The folder appears with its session in it. What fails before the first keyframe leaves nothing behind, and a folder
    that was to be replaced as it was; what fails later, or is killed, leaves a session to go on with.
    """
    check_free(out, overwrite=overwrite, reads=(source.path, source.odometry))
    begun_with = {"rig": rig, "prior": None if prior is None else prior.to_bytes(), "log": source.as_json()}
    with scratch_folder(out) as work:
        Session.make(work / SESSION_FILE, config, **begun_with)
        replaced = put_in_place(work, out)
    try:
        with Session.open(out / SESSION_FILE) as session:
            sync_folder(out.parent)  # after the session is open: its own sync of the journal has done most of this
            recorder = SessionRecorder(session, log=log, raw=source.raw, forget=source.forget_raw)
            yield PlaneSlam(config, prior=prior, recorder=recorder), log, rig
    except BaseException:
        if not _holds_keyframes(out):
            shutil.rmtree(out, ignore_errors=True)
            if replaced is not None:
                os.replace(replaced, out)
                replaced.parent.rmdir()
        raise


@contextmanager
def resumed_run(folder: Path, log_path: Path | None = None) -> Iterator[tuple[PlaneSlam, Log, Rig]]:
    """The run of a folder in the state in which it ended, however it ended: estimator, log to go on with, rig.

    The log may lie elsewhere by now, and it may have grown. FinishedAlready: there is nothing to go on with; LogError:
    no folder; SessionError: no session, a damaged one, or one in use, or another log.
    """
    check_folder_given(folder)
    with Session.open(folder) as session:
        if session.is_finished and not _is_open_to_repair(folder, session):
            raise FinishedAlready(f"{folder}: finished already; nothing is left to do")
        source = Source.of(session, log_path)
        if session.rig is None:
            raise SessionError(f"{session.path}: expected the session of a log, got one without a rig")
        log, rig = load(source.path, session.rig, keep_partial=source.keep_partial, odometry=source.odometry)
        log.assumed.extend(source.assumed)
        _check_log(session, source, log, rig)
        recorder = SessionRecorder(session, log=log, raw=source.raw, forget=source.forget_raw)
        yield resumed(PlaneSlam, session, recorder), log, rig


def _is_open_to_repair(folder: Path, session: Session) -> bool:
    """Whether a finished run found itself wrong before there was anything to be done about it."""
    try:
        numbers = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        return session.result(_REPAIRS) is None and numbers["verdict"]["verdict"] != "sound"
    except (OSError, ValueError, KeyError, TypeError):
        return False


def conclude(run: Run, folder: Path, write: Callable[[Path], None]) -> None:
    """Put the results of a run beside its session, then say in the session that it is finished.

    `write` writes them into a folder given; each is moved into its place when all are written. A run that dies in here
    is not finished: to resume it writes them again.
    """
    work = Path(tempfile.mkdtemp(prefix=_WORK, dir=folder))
    try:
        write(work)
        for made in sorted(work.iterdir()):
            target = folder / made.name
            if target.is_dir():
                shutil.rmtree(target)
            os.replace(made, target)
    finally:
        for left in folder.glob(f"{_WORK}*"):
            shutil.rmtree(left, ignore_errors=True)
    recorder = run.slam.recorder
    if isinstance(recorder, SessionRecorder):
        results: dict[str, bytes] = {}
        with suppress(BackendError):  # a map that cannot be a prior is a map all the same
            results["map"] = finished_map(run.planes, run.slam.landmarks, run.slam.backend)
        if run.repairs is not None:
            results[_REPAIRS] = json.dumps([asdict(repair) for repair in run.repairs]).encode()
        recorder.session.finish(**results)
    for replaced in replaced_by(folder):
        shutil.rmtree(replaced.parent, ignore_errors=True)


def _check_log(session: Session, source: Source, log: Log, rig: Rig) -> None:
    """The log must be the one that was, or one that has grown: then a keyframe of it is measured again."""
    known, now = session.log or {}, source.as_json()
    if _prints_of(known) == _prints_of(now):
        return
    index = max(len(session) - 2, 0)
    again = next(keyframes_of(log, rig, session.config, index), None)
    if len(session) and (again is None or not is_measured_again(session, index, again)):
        raise SessionError(f"{source.path}: expected the log that the run began with, got another one")
    session.set_log(now)


def _prints_of(source: dict[str, Any]) -> list[tuple[object, object]]:
    """What tells a log and its odometry from others, wherever they lie."""
    return [(file.get("bytes"), file.get("blake2b")) for file in (source, source.get("odometry") or {})]


def _holds_keyframes(folder: Path) -> bool:
    """Whether there is anything to lose; in doubt there is."""
    try:
        with Session.open(folder / SESSION_FILE, read_only=True) as session:
            return len(session) > 0
    except (ValueError, OSError):
        return (folder / SESSION_FILE).exists()
