"""The numbers of a run: one list of (metric, value, unit), for the screen, metrics.json and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from slam.evaluation import (
    Metric,
    absolute_error,
    facing_pairs,
    match_planes,
    metres_of_wall,
    plane_metrics,
    truth_T_estimate,
)
from slam.frontend.input_checks import blind, silences, skipped
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane
from slam.runs.mapping_run import MapResult
from slam.runs.slam_run import Run, path_length_m
from slam.sensors.log import Log
from slam.simulation.record import Truth
from spplanes import Plane


def metrics_of(run: Run) -> list[Metric]:
    """What can be said of a run without knowing the truth."""
    whose = "" if run.log.odometry_source is None else f" ({run.log.odometry_source.name})"
    rows = [
        Metric("keyframes", len(run.trajectory), ""),
        Metric("path length", path_length_m(run.trajectory), "m"),
        Metric("scans", len(run.scan_trajectory), ""),
        Metric(f"odometry readings{whose}", len(run.log.odometry), ""),
        Metric("planes in the map", len(run.planes), ""),
        Metric("landmarks tried", len(run.slam.landmarks), ""),
    ]
    if places := [repair for repair in run.repairs or () if repair.places]:
        rows.append(Metric("places laid anew", sum(repair.moved for repair in places), ""))
        rows.append(Metric("  the farthest by", max(repair.offset_m for repair in places), "m"))
    if starts := [repair for repair in run.repairs or () if repair.planes]:
        rows.append(Metric("start in the prior map moved by", starts[-1].offset_m, "m"))
    known = [landmark for landmark in run.slam.landmarks if landmark.known]
    if known:
        again = sum(bool(landmark.sightings or landmark.seen_by_past) for landmark in known)
        rows += [Metric("planes of the prior map", len(known), ""), Metric("  of them seen again", again, "")]
    n_walls, length = metres_of_wall(run.planes)
    if length > 0.0:
        rows.append(Metric("metres of wall", length, "m"))
        rows.append(Metric("wall landmarks per metre of wall", n_walls / length, "1/m"))
    rows += _pair_rows(run.planes)
    if steps := [step for step in run.slam.odometry_record.steps if step.check.off is not None]:
        rows.append(Metric("odometry errs, times what is stated, by 3D scans", steps[-1].scale, ""))
    rows += _calibration_rows(run)
    for summary in run.slam.audit.summary():
        band = f"{summary.low:.3f} to {summary.high:.3f}"
        rows.append(Metric(f"NIS per dof, {summary.kind} factors (95 % band {band})", summary.mean_per_dof, ""))
        rows.append(Metric(f"{summary.kind} factors", summary.count, ""))
    return rows


def map_metrics_of(result: MapResult) -> list[Metric]:
    """The table of a map made at given poses: the columns of the paper's, and the room."""
    seen = result.n_points_seen
    return [
        Metric("scans", len(result.trajectory), ""),
        Metric("points", seen, ""),
        Metric("planes", len(result.planes), ""),
        Metric("points represented", 100.0 * result.n_points_represented / seen if seen else 0.0, "%"),
        *_pair_rows(result.planes),
    ]


def timings_of(stages: Mapping[str, float]) -> list[Metric]:
    """Where the time went, by the seconds of every stage."""
    return [Metric(f"time, {stage}", seconds, "s") for stage, seconds in stages.items()]


def details_of(run: Run) -> dict[str, Any]:
    """What a table has no room for, for metrics.json."""
    return {
        "verdict": run.verdict.to_dict(),
        "evidence": [one.to_dict() for one in run.verdict.evidence],
        "repairs": [asdict(one) for one in run.repairs or ()],
        "facing_pairs": [asdict(pair) for pair in facing_pairs(run.planes)],
        "nis": [{**asdict(summary), "verdict": summary.verdict} for summary in run.slam.audit.summary()],
        "open_directions": [stretch.to_dict() for stretch in run.slam.open_directions],
        "open_in_map": [one.to_dict() for one in run.slam.open_in_map],
        "stages_s": dict(run.clock.seconds),
        "warnings": warnings_of(run),
        "notes": [*run.log.notes],
        "assumptions": assumptions_of(run.log),
    }


def warnings_of(run: Run) -> list[str]:
    """What whoever reads the numbers must know: one sentence each."""
    notes = [note for frame in run.slam.keyframes for note in frame.notes]
    rules = run.slam.config.observability
    # what a flat floor or the motion model holds to less than a tenth of that is no news to whoever drives
    limits = {"position": 0.1 * rules.max_sigma_m, "orientation": 0.1 * rules.max_sigma_rad}
    directions = [one.sentence for one in run.slam.open_directions if one.sigma >= limits[one.part]]
    known = run.slam.prior.warnings if run.slam.prior is not None else []
    health = [*skipped(notes), *silences(run.log, run.rig), *blind(run.slam.keyframes)]
    has_no_odometry = any(frame.motion is None for frame in run.slam.keyframes[1:])  # of some keyframe
    whole = [one.sentence for one in run.slam.open_in_map] if has_no_odometry else []
    return [*known, *empty_map(run.planes), *health, *run.slam.audit.warnings(), *directions, *whole]


def assumptions_of(log: Log) -> list[str]:
    """What a run took for granted because neither the log nor its user said it, one sentence each."""
    if log.measured_motion:
        return list(log.assumed)
    which = "the odometry never moves" if log.odometry else "no odometry"
    return [*log.assumed, f"{which}: how the robot moves is found by what it sees"]


def empty_map(planes: Sequence[MapPlane]) -> list[str]:
    """The sentence that says so where a map has no planes."""
    return [] if planes else ["the map is empty: no plane was seen often and well enough"]


def _calibration_rows(run: Run) -> list[Metric]:
    """What was found of the wheels' errors of calibration, where the rig states some or the drive shows some."""
    found = run.slam.calibration
    if found.covariance is None or not found.mean.any():
        return []
    mean, sigmas = found.mean, np.sqrt(np.diag(found.covariance))
    return [
        Metric("ways, longer than the odometry says", 100.0 * float(mean[0]), "%"),
        Metric("  its standard deviation (ways)", 100.0 * float(sigmas[0]), "%"),
        Metric("heading, turns more than the odometry says", float(np.rad2deg(mean[1])), "deg/m"),
        Metric("  its standard deviation (heading)", float(np.rad2deg(sigmas[1])), "deg/m"),
    ]


def _pair_rows(planes: Sequence[MapPlane]) -> list[Metric]:
    rows = []
    for pair in facing_pairs(planes)[:6]:
        between = f"planes {pair.first} and {pair.second}"
        rows.append(Metric(f"{pair.name} between {between}", pair.distance_m, "m"))
        rows.append(Metric(f"  its standard deviation ({between})", pair.sigma_m, "m"))
        rows.append(Metric(f"  from parallel ({between})", pair.angle_deg, "deg"))
    return rows


def metrics_against(run: Run, truth: Truth) -> list[Metric]:
    """The table of the demo: trajectory, room and planes of the estimate, and of odometry alone where it has them."""
    true_path = truth.trajectory
    rows = [Metric("path length", path_length_m(run.trajectory), "m")]
    rows += _trajectory_rows("estimate", run.trajectory, true_path)
    rows += _trajectory_rows("odometry alone", run.odometry, true_path)
    planes = in_frame_of_truth(run, true_path)
    rows += _room_rows(run, truth, planes)
    return rows + plane_metrics(list(planes.values()), truth.planes, visible=truth.visible_in_3d())


def in_frame_of_truth(run: Run, true_path: Trajectory) -> dict[int, Plane]:
    """Planes of the map that have a polygon, by landmark id, moved so that the first pose is the true one."""
    move = truth_T_estimate(run.trajectory, true_path)
    return {one.id: one.plane.transform(move) for one in run.planes if one.plane.outline is not None}


def _trajectory_rows(name: str, path: Trajectory, truth: Trajectory) -> list[Metric]:
    errors = absolute_error(path, truth, alignment="first")
    return [
        Metric(f"position error, rmse, {name}", float(np.sqrt(np.mean(errors.translation_m**2))), "m"),
        Metric(f"position error, last pose, {name}", float(errors.translation_m[-1]), "m"),
        Metric(f"orientation error, rmse, {name}", float(np.rad2deg(np.sqrt(np.mean(errors.rotation_rad**2)))), "deg"),
    ]


def _room_rows(run: Run, truth: Truth, moved: Mapping[int, Plane]) -> list[Metric]:
    """Height and width between the largest facing planes, and the same between their true planes."""
    found: dict[str, list[Metric]] = {"height": [], "width": []}
    for pair in facing_pairs(run.planes):
        if found[pair.name] or not moved.keys() >= {pair.first, pair.second}:
            continue
        matches = match_planes([moved[pair.first], moved[pair.second]], truth.planes)
        if len(matches) == 2:
            first, second = (truth.planes[match.true] for match in matches)
            found[pair.name] = [
                Metric(f"corridor {pair.name}, estimate", pair.distance_m, "m"),
                Metric(f"corridor {pair.name}, truth", abs(float(first.distance(second.centre))), "m"),
                Metric(f"corridor {pair.name}, predicted standard deviation", pair.sigma_m, "m"),
            ]
    return found["height"] + found["width"]
