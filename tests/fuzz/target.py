"""What a target is: bytes in, an answer that holds together or a ValueError of one sentence out."""

import tempfile
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slam.sensors.log import CloudScan, LaserScan, Log, OdometryReading
from spplanes import Plane

#: Longest sentence of an error.
LONGEST_SENTENCE = 400
#: Stands between the files of a target that reads several.
NEXT_FILE = b"\n--next file--\n"


@dataclass(frozen=True)
class Target:
    """Something that reads bytes."""

    name: str
    read: Callable[[Path], Any]  # reads a file and checks that the answer holds together
    seeds: Callable[[], list[bytes]]  # valid inputs
    suffix: str = ""
    wrap: Callable[[bytes], bytes] = bytes  # makes the file out of an input: checksums and archives
    is_numbers: bool = False  # an input is numbers of eight bytes, one after another

    def run(self, data: bytes, folder: Path) -> bool:
        """Feed it bytes; whether they were an answer. Everything but an answer and a ValueError gets through."""
        path = folder / f"input{self.suffix}"
        path.write_bytes(self.wrap(data))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                warnings.filterwarnings("ignore", "invalid value encountered in cast")  # a NaN that signals
                self.read(path)
        except ValueError as error:
            sentence = str(error)
            if "\n" in sentence or not 0 < len(sentence) <= LONGEST_SENTENCE + len(str(path)):
                raise AssertionError(f"not one sentence: {sentence!r}") from error
            if ran_out_of_memory(error):
                raise AssertionError(f"memory was taken before the sentence: {sentence!r}") from error
            return False
        return True


def ran_out_of_memory(error: BaseException | None) -> bool:
    """Whether there was no memory at the root of an error: with more of it, it would have been taken.

    To read more from a file than it has asks for memory, but takes none.
    """
    while error is not None:
        if isinstance(error, MemoryError):
            places = traceback.extract_tb(error.__traceback__)
            return not (places and ".read(" in (places[-1].line or ""))
        error = error.__cause__ or error.__context__
    return False


def unfolded(path: Path, names: tuple[str, ...]) -> Path:
    """A folder made of the files that one input holds, `NEXT_FILE` between them; those that end early are not made."""
    folder = path.parent / "folder"
    parts = path.read_bytes().split(NEXT_FILE, len(names) - 1)
    for place, name in enumerate(names):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        if place < len(parts):
            file.write_bytes(parts[place])
    return folder


def folded(*parts: bytes) -> bytes:
    """Inverse of `unfolded`."""
    return NEXT_FILE.join(parts)


def written(write: Callable[[Path], None], name: str) -> bytes:
    """What a writer writes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def check_log(log: Log) -> None:
    """Time ascends, numbers are numbers."""
    stamps = [event.stamp_ns for event in log.events]
    assert stamps and all(a <= b for a, b in pairwise(stamps))
    for event in log.events:
        if isinstance(event, OdometryReading):
            check_poses(event.odom_T_body)
        elif isinstance(event, LaserScan):
            assert event.ranges.shape == event.angles.shape and np.isfinite(event.angles).all()
            assert not np.isinf(event.ranges).any() and not (event.ranges <= 0.0).any()
        elif isinstance(event, CloudScan):
            check_points(event.points)


def check_points(points: np.ndarray) -> None:
    """Points of some shape (..., 3), none at infinity."""
    assert points.shape[-1] == 3 and points.dtype == np.float64 and not np.isinf(points).any()


def check_poses(poses: np.ndarray) -> None:
    """Rigid transforms (..., 4, 4)."""
    assert poses.shape[-2:] == (4, 4) and np.isfinite(poses).all()
    turns = poses[..., :3, :3]
    np.testing.assert_allclose(turns @ turns.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-2)


def check_planes(*planes: Plane) -> None:
    """Each has a frame, and a covariance that is one."""
    for plane in planes:
        check_poses(plane.frame)
        assert np.isfinite(plane.covariance).all()
        scale = float(np.abs(plane.covariance).max())
        assert np.linalg.eigvalsh(plane.covariance)[0] >= -1e-6 * scale
