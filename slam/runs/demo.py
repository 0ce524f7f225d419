"""The demo's verdict: a run on a simulated mission against the truth, odometry alone beside it."""

from __future__ import annotations

import numpy as np

from slam.evaluation import Metric, absolute_error, alignment_of, common_poses, match_planes, plane_metrics
from slam.evaluation.map_summary import facing_pairs
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane
from slam.runs.slam_run import Run, path_length_m
from slam.simulation.truth import Truth
from spplanes import Plane


def compare(run: Run, truth: Truth) -> list[Metric]:
    """The table of the demo: trajectory, room and planes of the estimate, and of odometry alone where it has them."""
    true_path = truth.trajectory
    rows = [Metric("path length", path_length_m(run.trajectory), "m")]
    rows += _trajectory_rows("estimate", run.trajectory, true_path)
    rows += _trajectory_rows("odometry alone", run.odometry, true_path)
    rows += _room_rows(run, truth)
    planes = in_frame_of_truth(run, true_path)
    return rows + plane_metrics(planes, truth.planes, visible=truth.visible_in_3d())


def in_frame_of_truth(run: Run, true_path: Trajectory) -> list[Plane]:
    """Planes of the map that have a polygon, moved so that the first pose is the true one."""
    _, estimated, true = common_poses(run.trajectory, true_path)
    truth_T_estimate = alignment_of(estimated, true, "first")
    return [plane.plane.transform(truth_T_estimate) for plane in run.planes if plane.plane.outline is not None]


def _trajectory_rows(name: str, path: Trajectory, truth: Trajectory) -> list[Metric]:
    errors = absolute_error(path, truth, alignment="first")
    return [
        Metric(f"position error, rmse, {name}", float(np.sqrt(np.mean(errors.translation_m**2))), "m"),
        Metric(f"position error, last pose, {name}", float(errors.translation_m[-1]), "m"),
        Metric(f"orientation error, rmse, {name}", float(np.rad2deg(np.sqrt(np.mean(errors.rotation_rad**2)))), "deg"),
    ]


def _room_rows(run: Run, truth: Truth) -> list[Metric]:
    """Height and width between the largest facing planes, and the same between their true planes."""
    moved = dict(zip([p.id for p in _with_outline(run)], in_frame_of_truth(run, truth.trajectory), strict=True))
    rows = []
    for name in ("height", "width"):
        for pair in facing_pairs(run.planes):
            if pair.name != name or pair.first not in moved or pair.second not in moved:
                continue
            matches = match_planes([moved[pair.first], moved[pair.second]], truth.planes)
            if len(matches) != 2:
                continue
            first, second = (truth.planes[match.true] for match in matches)
            rows.append(Metric(f"corridor {name}, estimate", pair.distance_m, "m"))
            rows.append(Metric(f"corridor {name}, truth", abs(float(first.distance(second.centre))), "m"))
            rows.append(Metric(f"corridor {name}, predicted standard deviation", pair.sigma_m, "m"))
            break
    return rows


def _with_outline(run: Run) -> list[MapPlane]:
    return [plane for plane in run.planes if plane.plane.outline is not None]
