"""Real logs of the corpus, and what is known to be true of each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._measure import DATA
from benchmarks.corpus.perturbed import PERTURBATIONS
from benchmarks.corpus.score import Row, error_row, said_row
from slam.config import SlamConfig
from slam.evaluation import PoseErrors, absolute_error
from slam.evaluation.trajectories import pose_errors, read_relations, relation_errors
from slam.geometry.frames import inverse, planar_transform
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.io.load import load
from slam.io.threedtk import read_frames
from slam.io.trajectories import Trajectory, read_tum
from slam.runs.slam_run import Run, run_slam

#: What ICP found of the second scan of pcl_room; not surveyed.
_ICP_YAW_DEG, _ICP_XYZ_M = 40.85, (1.964, 0.059, 0.010)


@dataclass(frozen=True)
class RealLog:
    """One log."""

    path: str  # file or folder below the data
    truth: str
    errors: Callable[[Run, Path], PoseErrors] | None = None  # of a run; None: nothing is known


def _relations(name: str) -> Callable[[Run, Path], PoseErrors]:
    return lambda run, data: relation_errors(run.scan_trajectory, read_relations(data / name))


def _of_poses(run: Run, true: np.ndarray) -> PoseErrors:
    """Errors pose by pose, after alignment of whole poses: the references are not exact at the first one either."""
    return absolute_error(run.trajectory, Trajectory(run.trajectory.stamps_ns, true), alignment="poses")


def _balm(run: Run, data: Path) -> PoseErrors:
    return _of_poses(run, read_tum(data / "balm_hall" / "lidar_odometry.tum").poses)


def _corridor(run: Run, data: Path) -> PoseErrors:
    frames = [read_frames(data / "3dtk_corridor" / f"scan{k:03d}.frames.4cc29d4c") for k in range(3)]
    return _of_poses(run, np.array(frames))


def _room(run: Run, data: Path) -> PoseErrors:
    """ICP's motion of the second scan; its roll and pitch are not told."""
    moved = planar_transform(*_ICP_XYZ_M[:2], float(np.deg2rad(_ICP_YAW_DEG)))
    moved[2, 3] = _ICP_XYZ_M[2]
    return pose_errors((inverse(moved) @ inverse(run.trajectory.poses[0]) @ run.trajectory.poses[-1])[None])


def _cabinet(run: Run, data: Path) -> PoseErrors:
    """Motion capture tells the camera's pose: that of the body, moved by the mount."""
    truth = read_tum(data / "tum_fr3_cabinet" / "truth" / "groundtruth.txt")
    return _of_poses(run, truth.poses_at(run.trajectory.stamps_ns.tolist()) @ inverse(CAMERA_MOUNT))


REAL: dict[str, RealLog] = {
    "3dtk_corridor": RealLog("3dtk_corridor", "3DTK's registration", _corridor),
    "balm_hall": RealLog("balm_hall", "lidar odometry, 1 to 2 cm", _balm),
    "pcl_room": RealLog("pcl_room", "ICP", _room),
    "tum_fr3_cabinet": RealLog("tum_fr3_cabinet", "motion capture", _cabinet),
    "loop5": RealLog("loop5/loop5.clf.gz", "none"),
    "intel": RealLog("intel/intel.clf.gz", "relations", _relations("intel/intel.relations.gz")),
    "intel_full": RealLog("intel/intel_full.clf.gz", "relations", _relations("intel/intel.relations.gz")),
    "aces": RealLog("aces/aces.clf.gz", "relations", _relations("aces/aces.relations.gz")),
    "fr079": RealLog("fr079/fr079.clf.gz", "relations", _relations("fr079/fr079.relations.gz")),
    "fr_clinic": RealLog("fr_clinic/fr-clinic.clf.gz", "none"),
}

#: Those of one laser and wheels with relations, which may be made worse.
WHEELED = ("intel", "intel_full", "aces", "fr079")


def real_row(name: str, config: SlamConfig, seed: int) -> Row:
    """Run a real log, LOG or LOG/PERTURBATION, and score it; a row that says why where the data are absent."""
    word, _, worse = name.partition("/")
    known = REAL[word]
    path = DATA / known.path
    if not path.exists():
        return {"state": f"skipped: {known.path} is not on this machine"}
    log, rig = load(path)
    if worse:
        log = PERTURBATIONS[worse](log, rig, np.random.default_rng(seed))
    run = run_slam(log, rig, config)
    row: Row = {"truth": known.truth}
    if known.errors is not None:
        row |= error_row(known.errors(run, DATA))
        row["judged"] = "wrong" if row["rmse, m"] > 0.1 else "-"
    return row | said_row(run)
