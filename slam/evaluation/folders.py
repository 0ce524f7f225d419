"""A run's folder against whatever truth there is: a mission, a trajectory, or relations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from slam.errors import LogError, check_truth_given
from slam.evaluation.planes import plane_metrics
from slam.evaluation.trajectories import (
    FOUND,
    STATED,
    Metric,
    PoseErrors,
    absolute_error,
    read_relations,
    relation_metrics,
    relative_error,
    truth_T_estimate,
)
from slam.geometry.frames import inverse
from slam.io.clouds.depth import CAMERA_POSES, is_depth_folder
from slam.io.planes_json import read_planes
from slam.io.trajectories import Trajectory, read_tum
from slam.sensors.rig import Rig
from slam.session.opening import check_finished, session_path
from slam.session.store import Session
from slam.simulation.record import Truth
from spplanes._check import FloatArray

#: Names of the rows that say how many poses were compared, and how many there are.
_COUNTS = ("poses compared", "poses of the run", "poses of the truth")
#: Before the names of the rows of the odometry, and the row in which both are compared in a sentence.
_ALONE, _ERROR = "odometry alone: ", "ATE translation rmse"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A run held against a truth."""

    rows: list[Metric]
    """The table."""
    notes: list[str]
    """What was compared, and what the numbers cannot say; one sentence each."""


def compare_with_truth(
    run: Path | str, truth: Path | str, *, truth_of: str | None = None, by_row: bool = False
) -> Evaluation:
    """Score the poses and planes of a run's folder, and beside them its odometry alone, if it has any.

    The poses are those of every scan (`scans.tum`), in folders of earlier versions those of keyframes.

    Args:
        run: the folder of a run.
        truth: a simulated mission's folder or its truth/ folder (trajectory and planes), a TUM file (trajectory), or a
            file of relations, whose name holds "relations".
        truth_of, by_row: of a TUM file, as `read_reference` takes them.

    Raises:
        LogError: a file that is missing or is not what it should be; a run that is not finished.
        ValueError: run and truth have no times in common, or options that do not fit.
    """
    run, truth = Path(run), Path(truth)
    check_finished(run)
    known, notes = None, []
    if truth.is_file() and "relations" not in truth.name:
        reference, notes = read_reference(run, truth, truth_of=truth_of, by_row=by_row)
        score = partial(trajectory_metrics, truth=reference)
    elif by_row or truth_of not in (None, BODY):
        raise ValueError(f"{truth}: expected a TUM trajectory where rows or a sensor's poses are asked for")
    elif truth.is_file():
        score = partial(relation_metrics, relations=read_relations(truth))
    else:
        check_truth_given(truth)
        known = Truth.read(_truth_folder(truth))
        score = partial(trajectory_metrics, truth=known.trajectory)
    rows = score(read_tum(best_path(run)))
    if (run / "odometry.tum").exists():
        alone = score(read_tum(run / "odometry.tum"))
        rows += [row._replace(name=f"{_ALONE}{row.name}") for row in alone]
    notes += _what_was_compared(run, rows)
    if known is not None:
        move = truth_T_estimate(read_tum(run / "trajectory.tum"), known.trajectory)
        planes = [plane.transform(move) for plane in read_planes(run / "planes.json") if plane.outline is not None]
        rows += plane_metrics(planes, known.planes, visible=known.visible_in_3d())
    return Evaluation(rows, notes)


def reference_for(run: Path, truth: Path, *, truth_of: str | None = None, by_row: bool = False) -> Trajectory:
    """The trajectory of a TUM file, or of a mission, to compare a run with, of the run's body."""
    if truth.is_file():
        return read_reference(run, truth, truth_of=truth_of, by_row=by_row)[0]
    return Truth.read(_truth_folder(truth)).trajectory


def _truth_folder(truth: Path) -> Path:
    return truth / "truth" if (truth / "truth").is_dir() else truth


def trajectory_metrics(estimate: Trajectory, truth: Trajectory) -> list[Metric]:
    """How many poses were compared, and their errors.

    Absolute errors of positions after SE(3) alignment of positions, of whole poses, and of the first pose; of rotations
    after alignment of whole poses and of the first; relative ones over 1 m. Positions alone say little of a turn where
    they are few or lie on a line.
    """
    by_poses = absolute_error(estimate, truth, alignment="poses")
    counts = by_poses.translation_m.size, len(estimate), len(truth)
    rows = [Metric(name, count, "") for name, count in zip(_COUNTS, counts, strict=True)]
    rows += PoseErrors(absolute_error(estimate, truth).translation_m, by_poses.rotation_rad).metrics("ATE")
    rows += [row for row in by_poses.metrics("ATE of aligned poses,") if row.unit == "m"]
    rows += absolute_error(estimate, truth, alignment="first").metrics("ATE from the first pose,")
    return rows + relative_error(estimate, truth).metrics("RPE over 1 m")


def _what_was_compared(run: Path, rows: list[Metric]) -> list[str]:
    """How much of the run and of the truth the figures are of, and how far so few can be believed."""
    values, file = {row.name: row.value for row in rows}, best_path(run).name
    if FOUND in values:
        return [f"scored {values[FOUND]} of {values[STATED]} relations, by {file}"]
    compared, of_run, of_truth = (values[name] for name in _COUNTS)
    notes = [f"compared {compared} of {of_run} poses of the run ({file}) with {of_truth} of the truth"]
    mine, alone = (values.get(f"{whose}{_ERROR}", np.nan) for whose in ("", _ALONE))
    if np.isfinite(alone):
        word = "less" if alone < mine else "more"
        notes.append(f"odometry alone errs by {alone:.4f} m, {word} than the estimate with {mine:.4f} m ({_ERROR})")
    spare = 3 * compared - 6  # an alignment in space takes six numbers
    doubt = float(np.sqrt(0.5 / spare)) if spare > 0 else 1.0  # relative, of a root mean square
    if doubt > 0.1:
        known = f"the errors themselves are known to {100 * doubt:.0f} % only" if spare > 0 else "nothing is left"
        notes.append(f"few poses: alignment takes 6 of their {3 * compared} coordinates, {known}")
    return notes


#: What `truth_of` says beside the name of a sensor.
BODY, SENSOR = "body", "sensor"


def best_path(run: Path) -> Path:
    """The run's poses at every scan, else at its keyframes: runs of earlier versions have no scans.tum."""
    scans = run / "scans.tum"
    return scans if scans.is_file() else run / "trajectory.tum"


def read_reference(
    run: Path, truth: Path, *, truth_of: str | None = None, by_row: bool = False
) -> tuple[Trajectory, list[str]]:
    """A TUM file as a trajectory of the run's body, in a world of its own, and what was done to it, one sentence each.

    Args:
        run: the folder of the run.
        truth: the file.
        truth_of: what its poses are of: "body", "sensor" (the run's only one), or a sensor by its name in the run's
            rig; None: of the camera, where the file is the `groundtruth.txt` or `poses.tum` of depth images (beside
            them or one folder down, or those that the run was made from), else of the body.
        by_row: its poses are the run's one by one, whatever their times: clouds that tell no time are numbered.

    Raises:
        LogError: a file that cannot be read.
        ValueError: no such sensor, or, by row, not as many poses as the run has.
    """
    poses, notes = read_tum(truth), []
    if truth_of is None:
        truth_of = SENSOR if _is_of_camera(run, truth) else BODY
    if truth_of != BODY:
        name, body_T_sensor = _sensor(run, truth_of)
        poses = Trajectory(poses.stamps_ns, poses.poses @ inverse(body_T_sensor))
        notes.append(f"{truth.name} is of the sensor {name!r}: moved to the body by the mount in the run's rig")
    if by_row:
        stamps = read_tum(best_path(run)).stamps_ns
        if len(poses) != len(stamps):
            raise ValueError(f"{truth}: expected, by row, as many poses as the run's {len(stamps)}, got {len(poses)}")
        poses = Trajectory(stamps, poses.poses)
        notes.append(f"{truth.name} was taken row by row, whatever its times")
    return poses, notes


def _is_of_camera(run: Path, truth: Path) -> bool:
    if truth.name not in CAMERA_POSES:
        return False
    if any(is_depth_folder(folder) for folder in truth.resolve().parents[:2]):
        return True
    if not session_path(run).is_file():
        return False
    with Session.open(run, read_only=True) as session:  # it says what the run was made from
        return session.log is not None and is_depth_folder(Path(session.log["path"]))


def _sensor(run: Path, wanted: str) -> tuple[str, FloatArray]:
    """Name and body_T_sensor (4, 4) of a sensor of the run's rig."""
    path = run / "rig.yaml"
    if not path.is_file():
        raise LogError(path, "expected the rig of the run, found none: a truth of a sensor cannot be moved to the body")
    sensors = Rig.from_yaml(path).sensors
    there = ", ".join(sensors)
    if wanted == SENSOR and len(sensors) != 1:
        raise ValueError(f"truth_of: expected the name of one of the run's sensors ({there}), got {SENSOR!r}")
    name = next(iter(sensors)) if wanted == SENSOR else wanted
    if name not in sensors:
        raise ValueError(f"truth_of: expected {BODY!r}, {SENSOR!r} or one of the run's sensors ({there}), got {name!r}")
    return name, sensors[name].body_T_sensor
