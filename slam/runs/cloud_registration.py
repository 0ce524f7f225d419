"""Registration of two clouds by their planes: the pose of one in the other, with covariance and what is left open."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from factors._conventions import POSE3_TO_SP
from slam.config import SlamConfig
from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.clouds import read_cloud
from slam.io.load import load
from slam.io.trajectories import Trajectory, write_tum
from slam.runs.slam_run import Run, run_slam
from spplanes._check import FloatArray, as_transform
from spplanes.spmodel import transform_from_rpy

#: Seconds between two clouds that say nothing of when they were taken: a folder's numbering.
_STEP_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Registration:
    """The pose of cloud B in the frame of cloud A."""

    a_T_b: FloatArray
    """Takes points of B to A, shape (4, 4)."""
    covariance: FloatArray
    """Of its SP differential (x, y, z, phi, theta, psi), on the right as in `factors.relative_pose_factor`, (6, 6)."""
    n_planes: int
    """Planes that both clouds have."""
    open: tuple[str, ...]
    """One sentence for each direction, in the frame of A, that the planes leave open."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        sigmas = np.sqrt(np.diag(self.covariance))
        return {
            "a_T_b": self.a_T_b.tolist(),
            "xyz_m": self.a_T_b[:3, 3].tolist(),
            "ypr_deg": Rotation.from_matrix(self.a_T_b[:3, :3]).as_euler("ZYX", degrees=True).tolist(),
            "sigma_xyz_m": sigmas[:3].tolist(),
            "sigma_ypr_deg": np.rad2deg(sigmas[3:]).tolist(),
            "covariance": self.covariance.tolist(),
            "planes": self.n_planes,
            "open": list(self.open),
        }


def register_clouds(a: Path | str, b: Path | str, *, guess: FloatArray | None = None) -> Registration:
    """The pose of cloud B in the frame of cloud A, both files that `slam.io.clouds.read_cloud` reads.

    It is a run of two keyframes: planes with the noise of the clouds' sensor, matched, refused and solved as in any
    other run, so that what holds for a run's covariances holds here. Each cloud is in its sensor's frame.

    Args:
        a, b: the files.
        guess: a_T_b about as it should be, shape (4, 4) or a ``gtsam.Pose3``; None: about the same place.

    Raises:
        LogError: a file that cannot be read.
        ValueError: no planes that both have.
    """
    files = [Path(a), Path(b)]
    for path in files:
        read_cloud(path)  # what is wrong with a file is said with its own name
    start = None if guess is None else as_transform("guess", guess)
    run = _run_of_two(files, start)
    both = [plane for plane in run.planes if plane.observations > 1]
    if len(run.trajectory) != len(files) or not both:
        raise ValueError(f"{files[0].name}, {files[1].name}: expected planes that both clouds have, found none")
    first, second = run.trajectory.poses
    covariance = run.slam.marginal_covariance(gtsam.symbol("x", 1))[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    left_open = tuple(stretch.sentence for stretch in run.slam.open_directions)
    return Registration(inverse(first) @ second, np.asarray(covariance), len(both), left_open)


def _run_of_two(files: list[Path], guess: FloatArray | None) -> Run:
    """The run of a folder that holds just these clouds, in this order, and the guess as odometry."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number, path in enumerate(files):
            (folder / f"{number}{''.join(path.suffixes[-2:]).lower()}").symlink_to(path.resolve())
        if guess is not None:
            stamps = np.arange(2, dtype=np.int64) * _STEP_NS
            write_tum(folder / "odometry.tum", Trajectory(stamps, np.array([np.eye(4), guess])))
        return run_slam(*load(folder), SlamConfig())


def read_guess(text: str) -> FloatArray:
    """a_T_b (4, 4) out of X,Y,Z,YAW (m, deg), or a file of one pose: 4 x 4, 3 x 4, x y z qx qy qz qw, or a TUM line.

    ValueError, or its LogError with the file: anything else.
    """
    words = text.split(",")
    if len(words) == 4:
        try:
            x, y, z, yaw = (float(word) for word in words)
        except ValueError:
            raise ValueError(f"--guess: expected X,Y,Z,YAW or a file, got {text!r}") from None
        if not np.isfinite((x, y, z, yaw)).all():
            raise ValueError(f"--guess: expected finite numbers, got {text!r}")
        return transform_from_rpy((x, y, z, float(np.deg2rad(yaw)), 0.0, 0.0))
    path = Path(text)
    try:
        numbers = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except OSError as error:
        raise ValueError(f"--guess: expected X,Y,Z,YAW or a file that can be read, got {text!r}") from error
    except ValueError as error:
        raise LogError(path, "expected the numbers of one pose, got something else") from error
    return _pose_of(path, numbers)


def _pose_of(path: Path, numbers: FloatArray) -> FloatArray:
    pose = np.eye(4)
    if len(numbers) in (12, 16):
        pose[: len(numbers) // 4] = numbers.reshape(-1, 4)
    elif len(numbers) in (7, 8) and np.isfinite(numbers).all() and np.linalg.norm(numbers[-4:]) > 0.0:
        pose[:3, 3] = numbers[-7:-4]
        pose[:3, :3] = Rotation.from_quat(numbers[-4:]).as_matrix()
    else:
        raise LogError(path, f"expected one pose of 16, 12, 8 or 7 numbers, got {len(numbers)} numbers")
    try:
        return as_transform("pose", pose)
    except ValueError as error:
        raise LogError(path, str(error)) from error
