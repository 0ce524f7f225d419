"""A run's folder against whatever truth there is: a mission, a trajectory, or relations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.evaluation.metrics import Metric
from slam.evaluation.planes import plane_metrics
from slam.evaluation.references import BODY, best_path, read_reference
from slam.evaluation.relations import FOUND, STATED, relation_metrics
from slam.evaluation.trajectories import PoseErrors, absolute_error, alignment_of, common_poses, relative_error
from slam.given import check_truth_given
from slam.io.planes_json import read_planes
from slam.io.relations import read_relations
from slam.io.trajectories import Trajectory, read_tum
from slam.session.state import check_finished
from slam.simulation.truth import Truth
from spplanes.plane import Plane

#: Name of the row that says how many poses were compared.
COMPARED = "poses compared"
#: Before the names of the rows of the odometry, and the row in which both are compared in a sentence.
_ALONE, _ERROR = "odometry alone: ", "ATE translation rmse"
#: Numbers that an alignment in space takes, and the relative standard deviation of a root mean square beyond which a
#: sentence says so: that of n numbers is 1 / sqrt(2 n).
_ALIGNMENT, _MOST_DOUBT = 6, 0.1


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A run held against a truth."""

    rows: list[Metric]
    """The table."""
    notes: list[str]
    """What was compared, and what the numbers cannot say; one sentence each."""


def evaluate_run(
    run: Path | str, truth: Path | str, *, truth_of: str | None = None, by_row: bool = False
) -> list[Metric]:
    """The table of `compare_with_truth` alone."""
    return compare_with_truth(run, truth, truth_of=truth_of, by_row=by_row).rows


def compare_with_truth(
    run: Path | str, truth: Path | str, *, truth_of: str | None = None, by_row: bool = False
) -> Evaluation:
    """Score the poses and planes of a run's folder, and beside them its odometry alone, if it has any.

    The poses are those of every scan (`scans.tum`), in folders of earlier versions those of keyframes.

    Args:
        run: the folder of a run.
        truth: a simulated mission's folder or its truth/ folder (trajectory and planes), a TUM file (trajectory), or a
            file of relations, whose name holds "relations".
        truth_of, by_row: of a TUM file, as `slam.evaluation.references.read_reference` takes them.

    Raises:
        LogError: a file that is missing or is not what it should be; a run that is not finished.
        ValueError: run and truth have no times in common, or options that do not fit.
    """
    run, truth = Path(run), Path(truth)
    check_finished(run)
    if truth.is_file() and "relations" not in truth.name:
        reference = read_reference(run, truth, truth_of=truth_of, by_row=by_row)
        rows = _for_each_path(run, lambda path: trajectory_metrics(path, reference.trajectory))
        return Evaluation(rows, [*reference.notes, *_what_was_compared(run, rows)])
    if by_row or truth_of not in (None, BODY):
        raise ValueError(f"{truth}: expected a TUM trajectory where rows or a sensor's poses are asked for")
    if truth.is_file():
        relations = read_relations(truth)
        rows = _for_each_path(run, lambda path: relation_metrics(path, relations))
        return Evaluation(rows, _what_was_compared(run, rows))
    check_truth_given(truth)
    known = Truth.read(_truth_folder(truth))
    rows = _for_each_path(run, lambda path: trajectory_metrics(path, known.trajectory))
    trajectory = read_tum(run / "trajectory.tum")
    planes = _in_frame_of(known.trajectory, trajectory, read_planes(run / "planes.json"))
    found = plane_metrics(planes, known.planes, visible=known.visible_in_3d())
    return Evaluation(rows + found, _what_was_compared(run, rows))


def reference_for(run: Path, truth: Path, *, truth_of: str | None = None, by_row: bool = False) -> Trajectory:
    """The trajectory of a TUM file, or of a mission, to compare a run with, of the run's body."""
    if truth.is_file():
        return read_reference(run, truth, truth_of=truth_of, by_row=by_row).trajectory
    return Truth.read(_truth_folder(truth)).trajectory


def _truth_folder(truth: Path) -> Path:
    return truth / "truth" if (truth / "truth").is_dir() else truth


def _for_each_path(run: Path, score: Callable[[Trajectory], list[Metric]]) -> list[Metric]:
    """Score the trajectory, and the odometry alone where the run kept it."""
    rows = score(read_tum(best_path(run)))
    if (run / "odometry.tum").exists():
        alone = score(read_tum(run / "odometry.tum"))
        rows += [row._replace(name=f"{_ALONE}{row.name}") for row in alone]
    return rows


def trajectory_metrics(estimate: Trajectory, truth: Trajectory) -> list[Metric]:
    """How many poses were compared, and their errors.

    Absolute errors of positions after SE(3) alignment of positions, of whole poses, and of the first pose; of rotations
    after alignment of whole poses and of the first; relative ones over 1 m. Positions alone say little of a turn where
    they are few or lie on a line.
    """
    by_poses = absolute_error(estimate, truth, alignment="poses")
    n_compared = by_poses.translation_m.size
    rows = [
        Metric(COMPARED, n_compared, ""),
        Metric("poses of the run", len(estimate), ""),
        Metric("poses of the truth", len(truth), ""),
    ]
    rows += PoseErrors(absolute_error(estimate, truth).translation_m, by_poses.rotation_rad).metrics("ATE")
    rows += [row for row in by_poses.metrics("ATE of aligned poses,") if row.unit == "m"]
    rows += absolute_error(estimate, truth, alignment="first").metrics("ATE from the first pose,")
    return rows + relative_error(estimate, truth).metrics("RPE over 1 m")


def _what_was_compared(run: Path, rows: list[Metric]) -> list[str]:
    """How much of the run and of the truth the figures are of, and how far so few can be believed."""
    values = {row.name: int(row.value) for row in rows if row.unit == "" and row.value == row.value}
    file = best_path(run).name
    if FOUND in values:
        return [f"scored {values[FOUND]} of {values[STATED]} relations, by {file}"]
    compared = values[COMPARED]
    errors = {row.name: row.value for row in rows}
    notes = [
        f"compared {compared} of {values['poses of the run']} poses of the run ({file}) with "
        f"{values['poses of the truth']} of the truth"
    ]
    mine, alone = (errors.get(f"{whose}{_ERROR}", np.nan) for whose in ("", _ALONE))
    if np.isfinite(alone):
        word = "less" if alone < mine else "more"
        notes.append(f"odometry alone errs by {alone:.4f} m, {word} than the estimate with {mine:.4f} m ({_ERROR})")
    spare = 3 * compared - _ALIGNMENT
    doubt = float(np.sqrt(0.5 / spare)) if spare > 0 else 1.0
    if doubt > _MOST_DOUBT:
        known = f"the errors themselves are known to {100 * doubt:.0f} % only" if spare > 0 else "nothing is left"
        notes.append(f"few poses: alignment takes {_ALIGNMENT} of their {3 * compared} coordinates, {known}")
    return notes


def _in_frame_of(truth: Trajectory, estimate: Trajectory, planes: list[Plane]) -> list[Plane]:
    """The planes that have an outline, moved so that the first pose is the true one."""
    _, estimated, true = common_poses(estimate, truth)
    truth_T_estimate = alignment_of(estimated, true, "first")
    return [plane.transform(truth_T_estimate) for plane in planes if plane.outline is not None]
