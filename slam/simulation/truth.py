"""The truth of a simulated mission, and how it lies on disk."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io.planes_json import read_planes, write_planes
from slam.io.raw import check_ratio
from slam.io.trajectories import Trajectory, read_tum, write_tum
from slam.simulation.rigs import HORIZONTAL
from spplanes._check import FloatArray
from spplanes.plane import Plane

_TRAJECTORY, _PLANES, _LABELS = "trajectory.tum", "planes.json", "labels.npz"
#: A plane is there to be found when the sensors hit it more often than this.
ENOUGH_POINTS = 200


@dataclass(frozen=True, eq=False)
class Truth:
    """What really was where."""

    stamps_ns: np.ndarray
    """Times of the true poses: of every scan and odometry reading, ascending, shape (T,), int64."""
    world_T_body: FloatArray
    """True poses of the robot at those times, shape (T, 4, 4)."""
    planes: list[Plane]
    """The true planes; labels are indices into this list."""
    labels: dict[str, np.ndarray]
    """Plane that each beam hit, by sensor and in the order of its scans, shape (S, B) or (S, F, B), int32; -1: none."""

    @property
    def trajectory(self) -> Trajectory:
        """The true poses."""
        return Trajectory(self.stamps_ns, self.world_T_body)

    def poses_at(self, stamps_ns: np.ndarray) -> FloatArray:
        """True poses (N, 4, 4) at times (N,) of scans or odometry readings; any other time is a ValueError."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        places = np.minimum(np.searchsorted(self.stamps_ns, stamps_ns), len(self.stamps_ns) - 1)
        if not np.array_equal(self.stamps_ns[places], stamps_ns):
            raise ValueError("stamps_ns: expected times of scans or odometry readings of this mission, got another")
        return self.world_T_body[places]

    def visible(self, sensor: str | None = None, *, more_than: int = ENOUGH_POINTS) -> set[int]:
        """Indices of the planes that one sensor, or all together, hit more than so many times."""
        chosen = self.labels.values() if sensor is None else [self.labels[sensor]]
        counts = sum(
            (np.bincount(labels[labels >= 0], minlength=len(self.planes)) for labels in chosen),
            start=np.zeros(len(self.planes), dtype=np.int64),
        )
        return set(np.flatnonzero(counts > more_than).tolist())

    def visible_in_3d(self, *, more_than: int = ENOUGH_POINTS) -> set[int]:
        """The same for one of the sensors that give 3D points: a level laser alone sees lines, not planes."""
        sensors = [name for name in self.labels if name != HORIZONTAL]
        return set().union(*(self.visible(name, more_than=more_than) for name in sensors))

    def write(self, folder: Path) -> None:
        """Write trajectory.tum, planes.json (spplanes/1; the id is the label) and labels.npz into a folder."""
        write_tum(folder / _TRAJECTORY, self.trajectory)
        write_planes(folder / _PLANES, self.planes)
        with (folder / _LABELS).open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **self.labels)  # type: ignore[arg-type]

    @classmethod
    def read(cls, folder: Path | str) -> Truth:
        """Read what `write` wrote; anything else is a `LogError` naming the file."""
        folder = Path(folder)
        trajectory = read_tum(folder / _TRAJECTORY)
        return cls(
            trajectory.stamps_ns, trajectory.poses, read_planes(folder / _PLANES), _read_labels(folder / _LABELS)
        )


def _read_labels(path: Path) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                check_ratio(path, member.file_size, member.compress_size)
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except LogError:
        raise
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # numpy and zipfile raise whatever the broken bytes lead them to
        raise LogError(path, "expected arrays of labels as NumPy wrote them, got something else") from error
