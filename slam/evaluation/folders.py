"""A run's folder against whatever truth there is: a mission, a trajectory, or relations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.errors import LogError
from slam.evaluation.metrics import Metric
from slam.evaluation.planes import plane_metrics
from slam.evaluation.relations import relation_metrics
from slam.evaluation.trajectories import absolute_error, alignment_of, at_times_of, common_poses, relative_error
from slam.io.planes_json import read_planes
from slam.io.relations import read_relations
from slam.io.trajectories import Trajectory, read_tum
from slam.simulation.truth import Truth
from spplanes.plane import Plane


def evaluate_run(run: Path | str, truth: Path | str) -> list[Metric]:
    """Score trajectory.tum and planes.json of a run's folder, and beside them its odometry.tum, if it has one.

    Args:
        run: the folder of a run.
        truth: a simulated mission's folder or its truth/ folder (trajectory and planes), a TUM file (trajectory), or a
            file of relations, whose name holds "relations". A TUM file none of whose times are the run's, but with as
            many poses, is taken pose by pose: clouds that tell no time.

    Raises:
        LogError: a file that is missing or is not what it should be.
        ValueError: run and truth have no times in common.
    """
    run, truth = Path(run), Path(truth)
    if truth.is_file():
        if "relations" in truth.name:
            relations = read_relations(truth)
            return _for_each_path(run, lambda path: relation_metrics(path, relations))
        reference = reference_for(run, truth)
        return _for_each_path(run, lambda path: trajectory_metrics(path, reference))
    folder = truth / "truth" if (truth / "truth").is_dir() else truth
    if not folder.is_dir():
        raise LogError(truth, "expected a mission's folder, a trajectory or a file of relations, got nothing")
    known = Truth.read(folder)
    rows = _for_each_path(run, lambda path: trajectory_metrics(path, known.trajectory))
    trajectory = read_tum(run / "trajectory.tum")
    planes = _in_frame_of(known.trajectory, trajectory, read_planes(run / "planes.json"))
    return rows + plane_metrics(planes, known.planes, visible=known.visible_in_3d())


def reference_for(run: Path, truth: Path) -> Trajectory:
    """The trajectory of a TUM file, or of a mission, to compare a run with, at times of the run."""
    if truth.is_file():
        return at_times_of(read_tum(run / "trajectory.tum"), read_tum(truth))
    return Truth.read(truth / "truth" if (truth / "truth").is_dir() else truth).trajectory


def _for_each_path(run: Path, score: Callable[[Trajectory], list[Metric]]) -> list[Metric]:
    """Score the trajectory, and the odometry alone where the run kept it."""
    rows = score(read_tum(run / "trajectory.tum"))
    if (run / "odometry.tum").exists():
        alone = score(read_tum(run / "odometry.tum"))
        rows += [row._replace(name=f"odometry alone: {row.name}") for row in alone]
    return rows


def trajectory_metrics(estimate: Trajectory, truth: Trajectory) -> list[Metric]:
    """Absolute error after SE(3) alignment of positions, of whole poses, and of the first pose; relative over 1 m."""
    rows = absolute_error(estimate, truth).metrics("ATE")
    rows += absolute_error(estimate, truth, alignment="poses").metrics("ATE of aligned poses,")
    rows += absolute_error(estimate, truth, alignment="first").metrics("ATE from the first pose,")
    return rows + relative_error(estimate, truth).metrics("RPE over 1 m")


def _in_frame_of(truth: Trajectory, estimate: Trajectory, planes: list[Plane]) -> list[Plane]:
    """The planes that have an outline, moved so that the first pose is the true one."""
    _, estimated, true = common_poses(estimate, truth)
    truth_T_estimate = alignment_of(estimated, true, "first")
    return [plane.transform(truth_T_estimate) for plane in planes if plane.outline is not None]
