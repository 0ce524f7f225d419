"""Poses and planes from points, many views at once: ours beside mrob's pi-factor and Eigen-Factors on the same points.

Run as ``python -m benchmarks views``. Where mrob is not there, its accuracy on ef_bench is the one recorded with the
data. One repeat of a setting is all of its samples; times are per sample.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache, partial

import gtsam
import numpy as np

from benchmarks._factor_scenes import many_views, plane_key, pose_key
from benchmarks._measure import PROJECT, Case, Peer, Row, Task, measured
from benchmarks.peers import environment
from factors import facing, plane_factors, plane_landmark
from spplanes import Plane, fit_planes

DATA = PROJECT.parent / "shared" / "data" / "ef_bench"
SIGMA_M = 0.005
SAMPLES = 20
#: Settings by what they differ in: file's name, points per plane and pose, degrees, metres.
PEERS = ("pi-factor", "ef-dense")
Scene = dict[str, np.ndarray]


@cache
def samples(setting: str) -> list[Scene]:
    """The samples of a setting of ef_bench."""
    with np.load(DATA / "ef_bench.npz") as bench:
        part = {name: bench[f"{setting}_{name}"] for name in ("points", "pose", "label", "sample", "truth", "init")}
    scenes = []
    for k in range(SAMPLES):
        mine = part["sample"] == k
        scene = {
            "points": part["points"][mine],
            "poses": part["pose"][mine].astype(np.int64),
            "labels": part["label"][mine].astype(np.int64),
            "truth": part["truth"][k],
            "initial": part["init"][k],
            "sigma": np.array(SIGMA_M),
        }
        scenes.append(scene | {"planes": start_planes(scene)})
    return scenes


def start_planes(scene: Scene) -> np.ndarray:
    """Where the pi-factor starts its planes, (n, d) with n.x + d = 0: as the first pose sees them, shape (K, 4)."""
    rows = []
    for label in range(int(scene["labels"].max()) + 1):
        mine = (scene["labels"] == label) & (scene["poses"] == 0)
        points = scene["points"][mine] @ scene["truth"][0][:3, :3].T + scene["truth"][0][:3, 3]
        centre = points.mean(axis=0)
        normal = np.linalg.svd(points - centre)[2][2]
        rows.append(np.append(normal, -(normal @ centre)))
    return np.array(rows)


@cache
def all_from_all() -> list[Scene]:
    """100 poses that all see 30 planes, 50 points each."""
    return [many_views()]


def solve(scene: Scene) -> np.ndarray:
    """Positions (P, 3): planes of every pose fitted in its frame, landmarks in the first pose's, one optimisation."""
    n_planes = int(scene["labels"].max()) + 1
    groups = scene["poses"] * n_planes + scene["labels"]
    planes = fit_planes(scene["points"], labels=groups, sigma=float(scene["sigma"]))
    poses, labels = np.divmod(np.unique(groups), n_planes)
    planes = one_sided(planes, poses, labels, scene["initial"])
    keys = [pose_key(int(i)) for i in poses], [plane_key(int(j)) for j in labels]
    graph = plane_factors(planes, *keys, [pose_key(0)] * len(planes))
    graph.addPriorPose3(pose_key(0), gtsam.Pose3(scene["truth"][0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    values = gtsam.Values()
    for i, pose in enumerate(scene["initial"]):
        values.insert(pose_key(i), gtsam.Pose3(scene["truth"][0] if i == 0 else pose))
    for plane, i, j in zip(planes, poses, labels, strict=True):
        if i == 0:
            values.insert(plane_key(int(j)), plane_landmark(plane))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(pose_key(i)).translation() for i in range(len(scene["initial"]))])


def one_sided(planes: list[Plane], poses: np.ndarray, labels: np.ndarray, initial: np.ndarray) -> list[Plane]:
    """The planes with normals to the side from which each label was seen first."""
    side: dict[int, np.ndarray] = {}
    turned = []
    for plane, i, j in zip(planes, poses, labels, strict=True):
        first = side.setdefault(int(j), initial[i][:3, :3] @ plane.normal)
        turned.append(facing(plane, plane.centre + initial[i][:3, :3].T @ first))
    return turned


def score(scenes: list[Scene], positions: list[np.ndarray]) -> Row:
    """Root-mean-square position error over the poses, its median and its largest over the samples."""
    return errors_row(
        [
            float(np.sqrt(np.mean(np.sum((found - scene["truth"][:, :3, 3]) ** 2, axis=1))))
            for scene, found in zip(scenes, positions, strict=True)
        ]
    )


def errors_row(errors_m: list[float]) -> Row:
    """Median and largest of errors."""
    return {"error, mm": 1e3 * float(np.median(errors_m)), "largest, mm": 1e3 * max(errors_m), "note": None}


def by_mrob(peer: str, scenes: Callable[[], list[Scene]], setting: str | None, repeats: int) -> Row:
    """The row of one of mrob's factors; without mrob its recorded accuracy."""
    if environment.peer_python() is None:
        if setting is None:
            raise RuntimeError(environment.ABSENT)
        recorded = json.loads((DATA / "peers.json").read_text())[setting][peer]["ape_m"]
        return errors_row(recorded) | {"note": f"recorded; {environment.ABSENT}"}
    many = scenes()
    arrays = {f"{k}/{name}": value for k, scene in enumerate(many) for name, value in scene.items()}
    found = environment.call("mrob_planes", arrays, peer, str(repeats))
    return errors_row(found.pop("errors_m")) | found


def contenders(scenes: Callable[[], list[Scene]], setting: str | None) -> list[Task | Peer]:
    """Ours and mrob's two on the same samples."""
    many = scenes()
    ours = Task("spplanes", lambda: [solve(scene) for scene in many], partial(score, many), repeats=3)
    return [ours, *(Peer(f"mrob, {peer}", partial(by_mrob, peer, scenes, setting), 3) for peer in PEERS)]


def _settings() -> dict[str, Case]:
    if not DATA.is_dir():
        return {}
    cases: dict[str, Case] = {}
    with np.load(DATA / "ef_bench.npz") as bench:
        for k in range(6):
            points, turn, way = bench[f"c{k}_meta"][:3]
            name = f"ef_bench c{k}: {points:.0f} points, start {turn:.3g} deg, {way:.3g} m off, {SAMPLES} samples"
            cases[name] = partial(contenders, partial(samples, f"c{k}"), f"c{k}")
    return cases


CASES: dict[str, Case] = _settings() | {"100 poses, 30 planes, 50 points each": partial(contenders, all_from_all, None)}


def run(*, short: bool = False) -> list[Row]:
    """One row for each contender of each setting."""
    return measured("benchmarks.views", CASES, short=short)
