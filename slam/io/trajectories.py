"""Trajectories as files: TUM (`t x y z qx qy qz qw`) and KITTI (rows of 3x4), strict and in full precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from slam.errors import LogError
from slam.geometry.frames import NORM_TOLERANCE, norms_of, poses_of
from slam.io.raw import read_rows, seconds_from_ns
from spplanes._check import FloatArray, as_shape
from spplanes.registration import interpolate_poses


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in time order."""

    stamps_ns: np.ndarray
    """Times, strictly ascending, shape (N,), int64."""
    poses: FloatArray
    """world_T_body, shape (N, 4, 4)."""

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_ns)
        if stamps.ndim != 1 or not np.issubdtype(stamps.dtype, np.integer):
            raise ValueError(f"stamps_ns: expected integers of shape (N,), got {stamps.dtype} of shape {stamps.shape}")
        object.__setattr__(self, "stamps_ns", stamps.astype(np.int64))
        object.__setattr__(self, "poses", as_shape("poses", self.poses, (len(stamps), 4, 4)))
        if (np.diff(self.stamps_ns) <= 0).any():
            raise ValueError("stamps_ns: expected strictly ascending times, got times that repeat or run backwards")

    @classmethod
    def empty(cls) -> Trajectory:
        """A trajectory without poses."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def poses_at(self, stamps_ns: ArrayLike) -> FloatArray:
        """Poses at times (M,), shape (M, 4, 4), between two poses interpolated; beyond the ends they stand."""
        stamps = np.clip(np.asarray(stamps_ns, dtype=np.int64), self.stamps_ns[0], self.stamps_ns[-1])
        return interpolate_poses(self.stamps_ns, self.poses, stamps)


def nearest_stamp(wanted_ns: Sequence[int] | np.ndarray, stamps_ns: Sequence[int] | np.ndarray) -> np.ndarray:
    """Index into ascending `stamps_ns` (M,), M > 0, of the time nearest to each wanted one (N,); of two the earlier."""
    stamps, wanted = np.asarray(stamps_ns, dtype=np.int64), np.asarray(wanted_ns, dtype=np.int64)
    right = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    left, right = right - 1, np.minimum(right, len(stamps) - 1)
    return np.where(np.abs(stamps[left] - wanted) <= np.abs(stamps[right] - wanted), left, right)


def read_tum(path: Path | str) -> Trajectory:
    """Read a TUM trajectory; `#` lines are comments. Quaternions are normalised.

    Raises:
        LogError: one sentence with file and line: not eight finite numbers, a quaternion that is not one, time that
            repeats or runs backwards, no poses at all.
    """
    path = Path(path)
    stamps, values, lines = read_rows(path, columns=8, stamp_columns=1)
    norms, wrong = norms_of(values[:, 3:])
    for bad in np.flatnonzero(wrong)[:1]:
        raise LogError(path, f"expected a unit quaternion, got one of norm {norms[bad]:.6g}", line=lines[bad])
    times = stamps[:, 0]
    for bad in np.flatnonzero(np.diff(times) <= 0)[:1] + 1:
        raise LogError(path, "expected times that ascend, got one that repeats or runs backwards", line=lines[bad])
    return Trajectory(times, poses_of(values))


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a TUM trajectory: times exact to the nanosecond, numbers that read back to the same float, qw >= 0."""
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    numbers = np.hstack([trajectory.poses[:, :3, 3], quaternions]).tolist()
    with Path(path).open("w", encoding="ascii", newline="\n") as stream:
        stream.write("# timestamp_s tx ty tz qx qy qz qw\n")
        for stamp, row in zip(trajectory.stamps_ns.tolist(), numbers, strict=True):
            stream.write(" ".join([seconds_from_ns(stamp), *map(repr, row)]) + "\n")


def read_kitti(path: Path | str) -> FloatArray:
    """Read KITTI poses (N, 4, 4): twelve numbers a line, the upper 3x4 of world_T_body row by row; no times.

    Raises:
        LogError: one sentence with file and line: not twelve finite numbers, or a rotation that is not one.
    """
    path = Path(path)
    _, rows, lines = read_rows(path, columns=12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # numbers whose squares are infinite: no rotation either
        errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        proper = (errors <= NORM_TOLERANCE) & (np.linalg.det(rotations) > 0.0)
    for bad in np.flatnonzero(~proper)[:1]:
        raise LogError(path, "expected a right-handed rotation in columns 1-3, 5-7, 9-11", line=lines[bad])
    return poses


def write_kitti(path: Path | str, poses: FloatArray) -> None:
    """Write KITTI poses (N, 4, 4) with numbers that read back to the same floats."""
    with Path(path).open("w", encoding="ascii", newline="\n") as stream:
        for pose in as_shape("poses", poses, (None, 4, 4)):
            stream.write(" ".join(map(repr, pose[:3].ravel().tolist())) + "\n")
