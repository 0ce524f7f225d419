"""Cost of the factors beside GTSAM's own, in one run.

Run as ``python -m benchmarks factors``. One thread; contenders in turn, medians of repeats, kernels warmed up.
"""

from collections.abc import Callable
from functools import cache, partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L as plane_key
from gtsam.symbol_shorthand import X as pose_key

from benchmarks._measure import CPU, EACH, Case, Row, Task, measured
from factors import line_factor, plane_factor, plane_factors, plane_landmark
from factors._conventions import square_root_informations
from spplanes import Plane, ScanLine

#: Factors of the graph that is linearised, and how often that is repeated, for it takes milliseconds.
MANY, REPEATS = 3000, 41
#: Lines added to a graph whose step is timed.
LINES = 98
LINE = ScanLine(0.3, 2.0, np.diag([0.005, 0.01]) ** 2, np.zeros((2, 2)), np.arange(2))
#: Sigmas of planes (m, rad, rad): the stock factor's changing basis matters where the tilts' are very different.
TILTS = {"tilts 1:5": np.array([0.005, 0.002, 0.01]), "equal tilts": np.array([0.005, 0.005, 0.005])}
WITHOUT = "without the lines"


def random_frames(rng: np.random.Generator, n: int) -> np.ndarray:
    """Plane frames (n, 4, 4) within 5 m of the origin, whose normals look at it."""
    frames = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    for frame in frames:
        frame[:3, :3] = gtsam.Rot3.Rodrigues(2.0 * rng.normal(size=3)).matrix()
        frame[:3, 3] = rng.uniform(-5.0, 5.0, 3)
        if frame[:3, 2] @ frame[:3, 3] > 0.0:
            frame[:3, 1:3] *= -1.0
    return frames


def helix(n_poses: int) -> list[gtsam.Pose3]:
    """Poses half a metre or so apart on a circle of 20 m that climbs slowly."""
    turns = 0.025 * np.arange(n_poses)
    places = np.column_stack([20.0 * np.sin(turns), 20.0 - 20.0 * np.cos(turns), 0.2 * turns])
    return [gtsam.Pose3(gtsam.Rot3.Yaw(turn), place) for turn, place in zip(turns, places, strict=True)]


@cache
def walk(tilts: str) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[tuple[int, int, Plane]]]:
    """Odometry of 1,000 poses, their initial values, and 6,000 observations (pose, plane, Plane) of 200 planes."""
    rng, n_poses, n_planes, per_pose, sigmas = np.random.default_rng(1), 1000, 200, 6, TILTS[tilts]
    truth, frames = helix(n_poses), random_frames(rng, n_planes)
    for j, frame in enumerate(frames):
        frame[:] = truth[j * n_poses // n_planes].matrix() @ frame
    graph, values, seen = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    graph.addPriorPose3(pose_key(0), truth[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))
    step_noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.002)
    guess, covariance = truth[0], np.diag(sigmas) ** 2
    for i, pose in enumerate(truth):
        if i:
            step = truth[i - 1].between(pose).retract(0.002 * rng.normal(size=6))
            graph.push_back(gtsam.BetweenFactorPose3(pose_key(i - 1), pose_key(i), step, step_noise))
            guess = guess.compose(step)
        values.insert(pose_key(i), guess)
        first = min(i * n_planes // n_poses, n_planes - per_pose)
        for j in range(first, first + per_pose):
            z, theta, psi = sigmas * rng.normal(size=3)
            off = gtsam.Pose3(gtsam.Rot3.RzRyRx(psi, theta, 0.0), np.array([0.0, 0.0, z])).inverse().matrix()
            seen.append((i, j, Plane(pose.inverse().matrix() @ frames[j] @ off, covariance)))
    return graph, values, seen


def stock_factors(planes: list[Plane], poses: list[int], keys: list[int]) -> gtsam.NonlinearFactorGraph:
    """The wheel's OrientedPlane3Factor with the same noise."""
    graph = gtsam.NonlinearFactorGraph()
    roots = square_root_informations(np.stack([p.frame for p in planes]), np.stack([p.covariance for p in planes]))
    for plane, root, pose, key in zip(planes, roots, poses, keys, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
        graph.push_back(gtsam.OrientedPlane3Factor(np.array([*plane.normal, -plane.d]), noise, pose, key))
    return graph


@cache
def observed() -> tuple[gtsam.Values, list[Plane], list[int], list[int], list[int]]:
    """Values of 100 poses and 30 planes; planes seen, their pose keys, plane keys and anchor keys, MANY of each."""
    rng, values = np.random.default_rng(0), gtsam.Values()
    for i in range(100):
        turn = gtsam.Rot3.Rodrigues(rng.normal(size=3))
        values.insert(pose_key(i), gtsam.Pose3(turn, rng.uniform(-5.0, 5.0, 3)))
    frames = random_frames(rng, 30)
    planes = [Plane(frames[k % 30], np.diag(TILTS["tilts 1:5"]) ** 2) for k in range(MANY)]
    for j in range(30):
        values.insert(plane_key(j), plane_landmark(planes[j]))
    poses, keys = [pose_key(1 + k % 99) for k in range(MANY)], [plane_key(k // 99 % 30) for k in range(MANY)]
    return values, planes, poses, keys, [pose_key(0)] * MANY


def linearising(graphs: Callable[[], dict[str, gtsam.NonlinearFactorGraph]]) -> list[Task]:
    """Time to linearise one factor, in a graph of MANY."""
    how = {"repeats": REPEATS, "things": MANY}
    return [Task(name, partial(graph.linearize, observed()[0]), **how) for name, graph in graphs().items()]


def plane_graphs() -> dict[str, gtsam.NonlinearFactorGraph]:
    _, planes, poses, keys, anchors = observed()
    own = gtsam.NonlinearFactorGraph()
    for plane, pose, key in zip(planes, poses, keys, strict=True):
        own.push_back(plane_factor(plane, pose, key, anchor_key=pose))
    return {
        "plane_factor, anchored (native)": plane_factors(planes, poses, keys, anchors),
        "stock OrientedPlane3Factor": stock_factors(planes, poses, keys),
        "plane_factor, world (compiled)": plane_factors(planes, poses, keys),
        "plane_factor, own anchor (compiled)": own,
    }


def line_graphs() -> dict[str, gtsam.NonlinearFactorGraph]:
    """Lines in each form; a stock plane factor, which has a row more, beside them."""
    _, planes, poses, keys, _ = observed()
    upright, anchor = gtsam.OrientedPlane3(1.0, 0.0, 0.0, -2.0), pose_key(0)
    native, anchored, world = (gtsam.NonlinearFactorGraph() for _ in range(3))
    for pose, key in zip(poses, keys, strict=True):
        native.push_back(line_factor(LINE, np.eye(4), pose, key, anchor_key=anchor, expected=upright))
        anchored.push_back(line_factor(LINE, np.eye(4), pose, key, anchor_key=anchor))
        world.push_back(line_factor(LINE, np.eye(4), pose, key))
    return {
        "line_factor, anchored, expected (native)": native,
        "stock OrientedPlane3Factor": stock_factors(planes, poses, keys),
        "line_factor, anchored (compiled)": anchored,
        "line_factor, world (compiled)": world,
    }


def building() -> list[Task]:
    """Time to make one plane's factor."""
    _, planes, poses, keys, anchors = observed()

    def one_by_one() -> list[gtsam.NonlinearFactor]:
        seen = zip(planes, poses, keys, anchors, strict=True)
        return [plane_factor(plane, pose, key, anchor_key=anchor) for plane, pose, key, anchor in seen]

    return [
        Task("plane_factors", partial(plane_factors, planes, poses, keys, anchors), repeats=15, things=MANY),
        Task("stock, roots in bulk", partial(stock_factors, planes, poses, keys), repeats=15, things=MANY),
        Task("plane_factor, one by one", one_by_one, repeats=3, things=MANY),
    ]


def stepping(n: int) -> list[Task]:
    """One Gauss-Newton step with LINES lines on one wall: every call of a custom factor copies all n values."""
    wall, tasks = gtsam.OrientedPlane3(1.0, 0.0, 0.0, -2.0), []
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    for name, more, expected in (("native", LINES, wall), ("compiled", LINES, None), (WITHOUT, 0, None)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for i in range(n):
            values.insert(pose_key(i), gtsam.Pose3())
            graph.addPriorPose3(pose_key(i), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
        values.insert(plane_key(0), wall)
        direction = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
        graph.push_back(gtsam.OrientedPlane3DirectionPrior(plane_key(0), upright, direction))
        anchor = pose_key(0)
        graph.push_back(line_factor(LINE, np.eye(4), pose_key(1), plane_key(0), anchor_key=anchor, expected=wall))
        how = {"anchor_key": anchor, "expected": expected}
        for i in range(2, 2 + more):
            graph.push_back(line_factor(LINE, np.eye(4), pose_key(i), plane_key(0), **how))
        # one step by an optimiser that is not kept
        step = partial(lambda g, v: gtsam.GaussNewtonOptimizer(g, v).iterate(), graph, values)
        tasks.append(Task(name, step, repeats=9))
    return tasks


def solving(tilts: str) -> list[Task]:
    """The same graph of 1,000 poses, 200 planes and 6,000 observations with our factors and with stock ones."""
    _, _, seen = walk(tilts)
    first: dict[int, int] = {}
    for i, j, _ in seen:
        first.setdefault(j, i)
    # a few anchors for all, each some 15 poses from the first observer; the observer itself would be a custom factor
    shared = {j: min(15 + 30 * (i // 30) + (i % 30 == 15), 999) for j, i in first.items()}
    planes = [plane for _, _, plane in seen]
    keys = [pose_key(i) for i, _, _ in seen], [plane_key(j) for _, j, _ in seen]

    def ours(anchors: dict[int, int] | None) -> gtsam.NonlinearFactorGraph:
        return plane_factors(planes, *keys, None if anchors is None else [pose_key(anchors[j]) for _, j, _ in seen])

    return [
        _solver("ours, shared anchors", tilts, ours(shared), first, shared),
        _solver("stock", tilts, stock_factors(planes, *keys), first, None),
        _solver("ours, first observer", tilts, ours(first), first, first),
        _solver("ours, world", tilts, ours(None), first, None, repeats=1),
    ]


def _solver(
    by: str, tilts: str, factors: gtsam.NonlinearFactorGraph, first: dict, anchors: dict | None, repeats: int = 3
) -> Task:
    """Levenberg-Marquardt; iterations and chi2 per degree of freedom."""
    odometry, poses, seen = walk(tilts)
    graph, values = gtsam.NonlinearFactorGraph(odometry), gtsam.Values(poses)
    graph.push_back(factors)
    for i, j, plane in seen:
        if first[j] == i:
            landmark = plane_landmark(plane, poses.atPose3(pose_key(i)))
            anchor = gtsam.Pose3() if anchors is None else poses.atPose3(pose_key(anchors[j]))
            values.insert(plane_key(j), landmark.transform(anchor))

    def solve() -> tuple[gtsam.Values, int]:
        solver = gtsam.LevenbergMarquardtOptimizer(graph, values)
        return solver.optimize(), solver.iterations()

    def score(found: tuple[gtsam.Values, int]) -> Row:
        dof = sum(graph.at(i).dim() for i in range(graph.size())) - found[0].dim()
        return {"iterations": found[1], "chi2/dof": 2.0 * graph.error(found[0]) / dof}

    return Task(by, solve, score, repeats=repeats)


CASES: dict[str, Case] = {
    f"linearise {MANY:,} planes": partial(linearising, plane_graphs),
    f"linearise {MANY:,} lines": partial(linearising, line_graphs),
    f"make {MANY:,} factors": building,
    **{f"Gauss-Newton step, {LINES} lines, {n:,} values": partial(stepping, n) for n in (100, 1000, 5000)},
    **{f"batch of 6,000 planes, {tilts}": partial(solving, tilts) for tilts in TILTS},
}


def run(*, short: bool = False) -> list[Row]:
    """One row for each contender of each case; what one line adds to a step is its time less that without lines."""
    rows = measured("benchmarks.factors", CASES, short=short)
    bare = {row["case"]: row[CPU] for row in rows if row["by"] == WITHOUT}
    for row in rows:
        if row["case"] in bare and row["by"] != WITHOUT:
            row[EACH] = 1e3 * (row[CPU] - bare[row["case"]]) / LINES
    return rows
