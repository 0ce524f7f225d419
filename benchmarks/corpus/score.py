"""A run against the truth, in one row: errors over all scans, errors over claimed sigmas, landmarks, the verdict."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from scipy.stats import chi2
from shapely import Polygon, unary_union

from benchmarks.corpus.drives import Drive
from slam.config import SlamConfig
from slam.evaluation import PlaneMatch, PoseErrors, absolute_error, match_planes, truth_T_estimate
from slam.evaluation.planes import outline_in
from slam.evaluation.trajectories import common_poses
from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane, pose_symbol
from slam.runs.slam_run import Run
from spplanes import Plane
from spplanes._check import FloatArray

Row = dict[str, Any]

#: Tangent of Pose3 in the floor plane: yaw, x, y.
IN_PLANE = [2, 3, 4]
#: A run is wrong whose worst error is beyond the larger of these, and right whose root mean square error, for the worst
#: of a thousand scans is three sigmas off by right, is within the larger of those: m, and claimed sigmas.
WRONG, RIGHT = (0.1, 3.0), (0.01, 2.0)
#: Disturbances that no run may call sound, however little they moved it.
MISLEADING = ("backwards", "prior_start", "prior_elsewhere")
#: One landmark in so many is further off than its covariance allows; those are the ones "beyond".
BEYOND = 1e-3
#: Landmarks of one true plane that lie farther apart than this are not doubles of each other, m: the gap that
#: association bridges by default.
GAP_M = SlamConfig().association.gap_m
#: Walls seen by lines are this wide to either side of them, for finding the true wall, m.
STRIP_M = 0.05


def score(run: Run, drive: Drive) -> Row:
    """The row of a simulated drive.

    Errors are of positions where the first keyframe is put on its true pose; in a prior map of this very building,
    in the map. A drive that begins in the map of another building has no error but its own: what it must not do is
    call itself sound.
    """
    in_map = drive.prior is not None and drive.recipe.disturbance != "prior_elsewhere"
    move = np.eye(4) if in_map else truth_T_estimate(run.trajectory, drive.truth.trajectory)
    scans = Trajectory(run.scan_trajectory.stamps_ns, move @ run.scan_trajectory.poses)
    errors = absolute_error(scans, drive.truth.trajectory, alignment="none")
    stamps, _, _ = common_poses(scans, drive.truth.trajectory)
    row = error_row(errors)
    sigma = _sigma_at(run, drive, int(stamps[np.argmax(errors.translation_m)]), in_map=in_map)
    row |= {"sigma, m": sigma, "judged": judged(row["worst, m"], row["rmse, m"], sigma, drive.recipe.disturbance)}
    return row | _last_pose(run, drive, in_map=in_map) | _landmarks(run, drive, move) | said_row(run)


def error_row(errors: PoseErrors) -> Row:
    """How many poses were compared, and how far off they are."""
    translation_m, rotation_rad = errors.translation_m, errors.rotation_rad
    return {
        "compared": int(translation_m.size),
        "rmse, m": float(np.sqrt(np.mean(translation_m**2))),
        "worst, m": float(translation_m.max()),
        "last, m": float(translation_m[-1]),
        "rmse, deg": float(np.rad2deg(np.sqrt(np.mean(rotation_rad**2)))),
    }


def said_row(run: Run) -> Row:
    """What the run says of itself."""
    return {"keyframes": len(run.trajectory), **run.verdict.to_dict()}


def judged(worst_m: float, rmse_m: float, sigma_m: float, disturbance: str = "none") -> str:
    """What truth says of a run with such a worst error, where it claims that sigma, and such a root mean square.

    Wrong; right; open: far off, but within what it claims, as where nothing tells how far a corridor was driven;
    misled: it is not wrong, but what it was told is, and it must say so; or between these.
    """
    if worst_m > max(WRONG[0], WRONG[1] * sigma_m):
        return "wrong"
    if disturbance in MISLEADING:
        return "misled"
    if rmse_m > max(RIGHT[0], RIGHT[1] * sigma_m):
        return "between"
    return "open" if worst_m > WRONG[0] else "right"


def _sigma_at(run: Run, drive: Drive, stamp_ns: int, *, in_map: bool) -> float:
    """Claimed standard deviation at a time, along the error of the nearest keyframe, m.

    That of the keyframe, and what odometry adds between two keyframes by the rig's own word.
    """
    keyframe = int(np.argmin(np.abs(run.trajectory.stamps_ns - stamp_ns)))
    error = _error_of(run, drive, keyframe, in_map=in_map)[3:]
    covariance = run.slam.marginal_covariance(pose_symbol(keyframe))[3:, 3:]
    size = float(np.linalg.norm(error))
    variance = float(error @ covariance @ error) / size**2 if size > 0.0 else float(np.linalg.eigvalsh(covariance)[-1])
    return float(np.sqrt(variance + _variance_between(run, stamp_ns)))


def _variance_between(run: Run, stamp_ns: int) -> float:
    """Variance of a position that odometry carries from the keyframe before and to the one after a time, m^2."""
    if not run.log.odometry:
        return 0.0
    track, known = OdometryTrack(run.log.odometry, run.rig.odometry), run.trajectory.stamps_ns
    ends = [max(known[known <= stamp_ns], default=None), min(known[known >= stamp_ns], default=None)]
    sides = [sorted((int(end), stamp_ns)) for end in ends if end is not None]
    if any(start == end for start, end in sides):
        return 0.0
    variances = [float(np.linalg.eigvalsh(track.motion(*side).covariance[:2, :2])[-1]) for side in sides]
    return 1.0 / sum(1.0 / variance for variance in variances)


def _error_of(run: Run, drive: Drive, keyframe: int, *, in_map: bool) -> FloatArray:
    """Error of a keyframe's pose in its own frame, (rx, ry, rz, x, y, z), as its covariance has it."""
    estimated, true = run.trajectory.poses, drive.truth.poses_at(run.trajectory.stamps_ns)
    start = np.eye(4) if in_map else estimated[0] @ inverse(true[0])
    return gtsam.Pose3.Logmap(gtsam.Pose3(inverse(start @ true[keyframe]) @ estimated[keyframe]))


def _last_pose(run: Run, drive: Drive, *, in_map: bool) -> Row:
    """NEES of the last pose: in the floor plane where odometry and floor hold the rest, else of all six."""
    last = len(run.trajectory) - 1
    part = IN_PLANE if drive.level and drive.log.odometry else list(range(6))
    error = _error_of(run, drive, last, in_map=in_map)[part]
    covariance = run.slam.marginal_covariance(pose_symbol(last))[np.ix_(part, part)]
    return {"pose NEES": float(error @ np.linalg.solve(covariance, error)) if last else None, "pose dof": len(part)}


def _landmarks(run: Run, drive: Drive, move: FloatArray) -> Row:
    """NEES of the landmarks that are of a true plane, and shares of doubles, of invented and of missed ones."""
    of_planes = [one.plane.outline is not None for one in run.planes]
    planes = [_with_outline(one).transform(move) for one in run.planes]
    matches = match_planes(planes, drive.truth.planes)
    dof = np.array([3 if of_planes[match.estimated] else 2 for match in matches])
    pairs = [(planes[match.estimated], drive.truth.planes[match.true]) for match in matches]
    nees = np.array([_nees(*pair, k) for pair, k in zip(pairs, dof, strict=True)])
    true, wanted = {match.true for match in matches}, drive.truth.visible_in_3d()
    return {
        "planes": len(planes),
        "matched": len(matches),
        "plane NEES/dof": float(nees.sum() / dof.sum()) if matches else None,
        "beyond, %": 100.0 * float(np.mean(nees > chi2.isf(BEYOND, dof))) if matches else None,
        "duplicates": doubles(planes, matches),
        "invented": len(planes) - len(matches),
        "missed, %": 100.0 * len(wanted - true) / len(wanted) if wanted else None,
    }


def doubles(planes: Sequence[Plane], matches: Sequence[PlaneMatch]) -> int:
    """Landmarks beyond the first of each piece of a true plane: what lies apart by more than `GAP_M` is a piece."""
    pieces: dict[int, list[Polygon]] = defaultdict(list)
    for match in matches:
        first = next(one.estimated for one in matches if one.true == match.true)
        pieces[match.true].append(outline_in(planes[match.estimated], planes[first]))
    joined = (unary_union([one.buffer(GAP_M / 2.0) for one in outlines]) for outlines in pieces.values())
    return len(matches) - sum(len(getattr(one, "geoms", [one])) for one in joined)


def _with_outline(landmark: MapPlane) -> Plane:
    """The landmark's plane; of walls of which only lines were seen with a strip about these for an outline."""
    if landmark.plane.outline is not None:
        return landmark.plane
    strip = landmark.seen.buffer(STRIP_M)
    return replace(landmark.plane, outline=strip if isinstance(strip, Polygon) else strip.convex_hull)


def _nees(plane: Plane, true: Plane, dof: int) -> float:
    """Of shift and both tilts; with 2 degrees of freedom without the tilt that lines do not tell."""
    if dof == 3:
        return plane.mahalanobis(true)
    local = plane.frame[:3, :3].T @ true.normal
    slopes = -local[:2] / local[2]  # of the true plane over the frame of the estimated one
    shift = -float(true.distance(plane.centre)) / local[2]
    up = plane.frame[2, :2] / np.linalg.norm(plane.frame[2, :2])
    level = np.array([-up[1], up[0]])
    rows = np.array([[1.0, 0.0, 0.0], [0.0, -level[0], level[1]]])  # the surface is z - theta x + psi y
    error = np.array([shift, slopes @ level])
    return float(error @ np.linalg.solve(rows @ plane.covariance @ rows.T, error))
