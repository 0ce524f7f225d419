"""Simulated missions with truth, poses unknown: how good, and how honest, over many seeds.

    python -m benchmarks.missions [RUNS [SCANS [FIRST]]] [--rows FILE]       the corridor
    python -m benchmarks.missions office [RUNS [FIRST]] [--rows FILE]        two laps of an office of 79 m with rooms
    python -m benchmarks.missions summary FILE...                            what several such files say together

Seeds from FIRST on. Each row is printed as it comes, the summary at the end. With `--rows` every row is also appended
to a file, a line of JSON each, and seeds that are in it already are left out: a run goes on where it was interrupted,
and several processes may share the seeds out, each with a file of its own. Files hold one kind of mission.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import gtsam
import numpy as np
from scipy.stats import chi2, t

from benchmarks._kept_rows import Row, append_row, read_rows, seeds_left
from benchmarks._table import plain
from slam.config import SlamConfig
from slam.evaluation import PlaneMatch, absolute_error, match_planes, plane_metrics
from slam.geometry.frames import inverse
from slam.planeslam import pose_symbol
from slam.runs.demo import in_frame_of_truth
from slam.runs.slam_run import Run, run_slam
from slam.simulation import Mission, Truth, simulate_mission
from spplanes import Plane

#: Tangent of Pose3 in the floor plane: yaw, x, y.
IN_PLANE = [2, 3, 4]
#: A plane beyond this NEES is none of its own covariance: 1 in 1000 is.
BEYOND = float(chi2.isf(1e-3, 3))


def run(runs: int = 20, scans: int = 400, first: int = 0) -> list[Row]:
    """One row a seed, the corridor."""
    return list(corridor_rows(range(first, first + runs), scans))


def corridor_rows(seeds: Iterable[int], scans: int = 400) -> Iterator[Row]:
    """One row a seed; with height and width of the corridor, if its four sides were found."""
    for seed in seeds:
        yield _measured(seed, simulate_mission("corridor", n_scans=scans, seed=seed), sides=True)


def office_rows(seeds: Iterable[int]) -> Iterator[Row]:
    """One row a seed: two laps of the office."""
    for seed in seeds:
        yield _measured(seed, simulate_mission("office", laps=2, seed=seed))


def summary(rows: Sequence[Row]) -> list[Row]:
    """What the rows say together: medians, worst runs, and mean NEES with the bands they should lie in.

    Final poses are independent, so the band of their mean is that of chi2. Planes of one run share poses: the band
    stated is that of independent ones, thus too narrow. Beside it stands the interval that the spread of the runs
    themselves gives their mean: it holds 3 if the planes are honest.
    """
    poses, planes = [row["pose NEES"] for row in rows], [row["planes"] for row in rows]
    all_planes = float(np.average([row["plane NEES"] for row in rows], weights=planes))
    lines = [
        _spread("position rmse", [1e3 * row["position rmse, m"] for row in rows], "mm"),
        _spread("share of odometry's rmse", [row["share of odometry"] for row in rows], ""),
        _spread("planes, distance (median of a run)", [1e3 * row["plane distance, m"] for row in rows], "mm"),
        _spread("planes, angle (median of a run)", [row["plane angle, deg"] for row in rows], "deg"),
        _spread("planes, duplicates", [row["duplicates, %"] for row in rows], "%"),
        _spread("last pose, NEES", poses, "", _band(len(rows))),
        _spread("planes, NEES (mean of a run)", [row["plane NEES"] for row in rows], "", _interval(rows)),
        {"over all": "planes, NEES (all planes)", "mean": all_planes, "band": _band(int(np.sum(planes)))},
        _spread(f"planes beyond NEES {BEYOND:.1f}", [row["beyond, %"] for row in rows], "%"),
    ]
    for side in ("height", "width"):
        errors = [abs(row[f"{side} error, mm"]) for row in rows if row.get(f"{side} error, mm") is not None]
        if errors:
            lines.append(_spread(f"corridor, {side} error", errors, "mm"))
    return [{"runs": len(rows), **line} for line in lines]


def _spread(name: str, values: Sequence[float], unit: str, band: str | None = None) -> Row:
    median, mean, worst = (float(f(values)) for f in (np.median, np.mean, np.max))
    return {"over all": name, "unit": unit, "median": median, "mean": mean, "worst": worst, "band": band}


def _band(count: int) -> str:
    """The 95 % band of the mean of so many NEES of 3 degrees of freedom."""
    low, high = chi2.ppf([0.025, 0.975], 3 * count) / count
    return f"{low:.2f} to {high:.2f}"


def _interval(rows: Sequence[Row]) -> str | None:
    """The 95 % interval of the mean of the runs' mean NEES, from their spread."""
    if len(rows) < 2:
        return None
    values = np.array([row["plane NEES"] for row in rows])
    half = float(t.ppf(0.975, len(rows) - 1) * values.std(ddof=1) / np.sqrt(len(rows)))
    return f"mean is {values.mean() - half:.2f} to {values.mean() + half:.2f}"


def _measured(seed: int, mission: Mission, *, sides: bool = False) -> Row:
    start = time.process_time()
    done = run_slam(mission.log, mission.rig, SlamConfig())
    seconds = time.process_time() - start
    truth = mission.truth
    planes = in_frame_of_truth(done, truth.trajectory)
    matches = match_planes(planes, truth.planes)
    shares = {row.name: row.value for row in plane_metrics(planes, truth.planes, visible=truth.visible_in_3d())}
    position, odometry = _rmse(done, truth), _rmse(done, truth, odometry=True)
    nees = np.array([match.nees for match in matches])
    row = {
        "seed": seed,
        "position rmse, m": position,
        "odometry rmse, m": odometry,
        "share of odometry": position / odometry,
        "pose NEES": _pose_nees(done, truth),
        "planes": len(matches),
        "plane NEES": float(nees.mean()),
        "plane NEES, median (2.37)": float(np.median(nees)),
        "beyond, %": 100.0 * float(np.mean(nees > BEYOND)),
        "plane distance, m": shares["plane distance median"],
        "plane angle, deg": shares["plane angle median"],
        "duplicates, %": shares["planes duplicate"],
        "missed, %": shares["planes missed"],
        "CPU s": seconds,
    }
    return row | _side_errors(planes, matches, truth.planes) if sides else row


def _side_errors(planes: Sequence[Plane], matches: Sequence[PlaneMatch], true: Sequence[Plane]) -> Row:
    """Height and width of the corridor less the true ones, mm; None where a side was not found."""
    errors: Row = {}
    for name, axis in (("height", 2), ("width", 1)):
        pair = [_best_of(side, planes, matches) for side in _sides(true, axis)]
        error = None
        if pair[0] is not None and pair[1] is not None:
            (a, true_a), (b, true_b) = ((planes[match.estimated], true[match.true]) for match in pair if match)
            error = 1e3 * float(abs(a.distance(b.centre)) - abs(true_a.distance(true_b.centre)))
        errors[f"{name} error, mm"] = error
    return errors


def _sides(true: Sequence[Plane], axis: int) -> list[int]:
    """The largest of the planes that look up an axis, and of those that look down it."""
    areas = [0.0 if plane.outline is None else plane.outline.area for plane in true]
    ways = [[sign * plane.normal[axis] > 0.99 for plane in true] for sign in (1.0, -1.0)]
    return [max(np.flatnonzero(way).tolist(), key=areas.__getitem__) for way in ways]


def _best_of(side: int, planes: Sequence[Plane], matches: Sequence[PlaneMatch]) -> PlaneMatch | None:
    """The estimated plane of a true one, the one with most points if there are several."""
    mine = [match for match in matches if match.true == side]
    return max(mine, key=lambda match: planes[match.estimated].n_points, default=None)


def _rmse(done: Run, truth: Truth, *, odometry: bool = False) -> float:
    path = done.odometry if odometry else done.trajectory
    return float(np.sqrt(np.mean(absolute_error(path, truth.trajectory, alignment="first").translation_m ** 2)))


def _pose_nees(done: Run, truth: Truth) -> float:
    """NEES of the last pose in the floor plane, relative to the first, whose own covariance is the prior's."""
    true = truth.poses_at(done.trajectory.stamps_ns)
    relative = inverse(true[0]) @ true[-1]
    error = gtsam.Pose3.Logmap(
        gtsam.Pose3(inverse(relative) @ inverse(done.trajectory.poses[0]) @ done.trajectory.poses[-1])
    )
    covariance = done.slam.marginal_covariance(pose_symbol(len(true) - 1))[np.ix_(IN_PLANE, IN_PLANE)]
    return float(error[IN_PLANE] @ np.linalg.solve(covariance, error[IN_PLANE]))


def main() -> None:
    """Print the rows as they come, then the summary."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.missions")
    parser.add_argument("words", nargs="*", help="[office] and numbers, or summary and files; see above")
    parser.add_argument("--rows", type=Path, help="file to which rows are appended, a line of JSON each")
    given = parser.parse_args()
    kind = given.words[0] if given.words and not given.words[0].isdigit() else "corridor"
    words = given.words[kind != "corridor" :]
    if kind == "summary":
        rows = read_rows(Path(word) for word in words)
    elif kind in ("corridor", "office") and all(word.isdigit() for word in words):
        rows = _run_and_keep(kind, [int(word) for word in words], given.rows)
    else:
        parser.error(f"expected numbers after the kind of mission, corridor or office, got {' '.join(given.words)}")
    if not rows:
        parser.error("expected rows, found none")
    print(plain(summary(rows)))


def _run_and_keep(kind: str, numbers: Sequence[int], path: Path | None) -> list[Row]:
    """The rows asked for; those in the file already are not run again."""
    runs, scans, first = (*numbers, *(20, 400, 0)[len(numbers) :])
    if kind == "office":
        runs, first = (*numbers, *(10, 0)[len(numbers) :])
    seeds = range(first, first + runs)
    kept = read_rows([path] if path else [])
    left = seeds_left(seeds, kept)
    rows = [row for row in kept if row["seed"] in seeds]
    for row in office_rows(left) if kind == "office" else corridor_rows(left, scans):
        rows.append(row)
        if path:
            append_row(path, row)
        print(", ".join(f"{name} {cell_of(value)}" for name, value in row.items()), flush=True)
    return rows


def cell_of(value: float | None) -> str:
    """A value in three digits."""
    return "-" if value is None else f"{value:.3g}"


if __name__ == "__main__":
    main()
