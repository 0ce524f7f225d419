"""As good as eliminating the planes: a synthetic benchmark beside its peers' errors on the same inputs."""

import json
from collections.abc import Iterator

import gtsam
import numpy as np
import pytest

from factors import facing, plane_factors, plane_landmark
from spplanes import Plane, fit_planes
from tests.slam.real_data import DATA

BENCH = DATA / "ef_bench"
PEERS = ("bareg", "pi-factor", "ef-alternating", "ef-dense")
SETTINGS = [f"c{k}" for k in range(6)]
SIGMA_M = 0.005

pytestmark = pytest.mark.skipif(not BENCH.exists(), reason="the benchmark's data are not beside the repository")

Scene = dict[str, np.ndarray]


def samples(setting: str) -> Iterator[Scene]:
    """Points of a setting with their poses and planes, true poses and where they start."""
    with np.load(BENCH / "ef_bench.npz") as bench:
        part = {name: bench[f"{setting}_{name}"] for name in ("points", "pose", "label", "sample", "truth", "init")}
    for k in range(len(part["truth"])):
        mine = part["sample"] == k
        poses, labels = (part[name][mine].astype(np.int64) for name in ("pose", "label"))
        known = {"poses": poses, "labels": labels, "truth": part["truth"][k], "initial": part["init"][k]}
        yield {"points": part["points"][mine], **known}


def solve(scene: Scene) -> np.ndarray:
    """Positions (P, 3): planes of every pose fitted in its frame, landmarks in the first pose's, one optimisation."""
    n_planes = int(scene["labels"].max()) + 1
    groups = scene["poses"] * n_planes + scene["labels"]
    planes = fit_planes(scene["points"], labels=groups, sigma=SIGMA_M)
    poses, labels = np.divmod(np.unique(groups), n_planes)
    planes = one_sided(planes, poses, labels, scene["initial"])
    x, p = ([gtsam.symbol(letter, int(k)) for k in numbers] for letter, numbers in (("x", poses), ("p", labels)))
    graph, first = plane_factors(planes, x, p, [gtsam.symbol("x", 0)] * len(planes)), gtsam.Pose3(scene["truth"][0])
    graph.addPriorPose3(gtsam.symbol("x", 0), first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    values = gtsam.Values()
    for i, pose in enumerate(scene["initial"]):
        values.insert(gtsam.symbol("x", i), first if i == 0 else gtsam.Pose3(pose))
    for plane, i, key in zip(planes, poses, p, strict=True):
        if i == 0:
            values.insert(key, plane_landmark(plane))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(gtsam.symbol("x", i)).translation() for i in range(len(scene["initial"]))])


def one_sided(planes: list[Plane], poses: np.ndarray, labels: np.ndarray, initial: np.ndarray) -> list[Plane]:
    """The planes with normals to the side from which each label was seen first."""
    side: dict[int, np.ndarray] = {}
    turned = []
    for plane, i, j in zip(planes, poses, labels, strict=True):
        first = side.setdefault(int(j), initial[i][:3, :3] @ plane.normal)
        turned.append(facing(plane, plane.centre + initial[i][:3, :3].T @ first))
    return turned


def test_the_median_error_is_near_the_best_peers_and_no_sample_fails():
    """Eigen-Factors has samples a metre off; a landmark's basin is wider."""
    peers = json.loads((BENCH / "peers.json").read_text())
    for setting in SETTINGS:
        away = [solve(scene) - scene["truth"][:, :3, 3] for scene in samples(setting)]
        errors_m = np.sqrt(np.mean(np.sum(np.square(away), axis=2), axis=1))
        best = min(np.median(peers[setting][peer]["ape_m"]) for peer in PEERS)
        assert np.median(errors_m) <= 1.05 * best, setting
        assert errors_m.max() < 0.1, setting
