"""Planes of whole scenes beside Open3D's two ways, on the same points: accuracy, time and memory.

Run as ``python -m benchmarks scenes``. Open3D gets the points that are returns, as a cloud; normals, which its patches
need, are part of its time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._boxes import polyhedra_scan
from benchmarks._measure import DATA, Case, Row, Task, measured
from slam.io.clouds.depth import Camera
from slam.io.threedtk import read_points
from slam.sensors.rig import LocalisationNoise
from slam.simulation import simulate_mission
from spplanes import MapperConfig, Plane, segment_scans
from spplanes._check import FloatArray
from spplanes.noise import DepthCameraModel, SensorModel
from spplanes.registration import register_scans

#: The iterative RANSAC: points of the smallest plane, planes at most, tries each.
LEAST_POINTS, MOST_PLANES, TRIES = 200, 20, 100
#: The tilting SICK of 3dtk_corridor: 1 cm of range noise; its tilt servo jerks from line to line, and drifts.
CORRIDOR_SENSOR = SensorModel(
    range_sigma_m=0.01, scan_shift_sigma_m=0.005, scan_tilt_sigma_rad=0.003, surface_sigma_m=0.02
)


@dataclass(frozen=True, eq=False)
class Scene:
    """Points and how they are segmented by us."""

    points: FloatArray  # shape (S, B, 3); NaN: no return
    segment: Callable[[], tuple[np.ndarray, list[Plane]]]  # ours: labels (S, B), planes
    distance_m: float  # inlier distance for RANSAC: three sigma of the points across planes
    truth: np.ndarray | None  # label of the true plane, shape (S, B), 1 and up; 0: none
    wanted_points: int = 0  # true planes count that have more points than this

    @property
    def returns(self) -> np.ndarray:
        """Mask of the returns, shape (S, B)."""
        return np.asarray(np.isfinite(self.points).all(axis=-1))


def icl_frame(data: Path, noise_seed: int | None = None) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Points (480, 640, 3), sigma per point and labels (0 = none) of the labelled depth image.

    With a seed, depths get the Kinect's axial noise (`DepthCameraModel`); without, their quantisation is the noise.
    """
    from matplotlib import image

    depth = np.round(image.imread(data / "icl_labelled" / "depth.png") * 65535.0) / 5000.0
    camera = np.loadtxt(data / "icl_labelled" / "intrinsics.txt")
    labels = np.load(data / "icl_labelled" / "labels.npy").reshape(depth.shape).astype(np.int64)
    sigma = np.full(depth.shape, 0.0002 / np.sqrt(12.0))
    if noise_seed is not None:
        sigma = DepthCameraModel().depth_sigma(depth)
        noise = sigma * np.random.default_rng(noise_seed).standard_normal(depth.shape)
        depth = np.where(depth > 0.0, depth + noise, 0.0)
    return Camera(camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]).points(depth), sigma, labels


def synpeb_scan(data: Path) -> tuple[FloatArray, float, np.ndarray]:
    """Points (100, 100, 3), sigma and labels of the SynPEB scan; its residuals about the true planes are about 1 mm."""
    lines = (data / "synpeb" / "test_100.pcd").read_text(encoding="latin1").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("DATA")) + 1
    values = np.loadtxt(lines[start:])
    return values[:, :3].reshape(100, 100, 3), 0.001, values[:, 3].reshape(100, 100).astype(np.int64)


def corridor_scan(data: Path, index: int) -> FloatArray:
    """One scan of the 3DTK corridor, metric, x forward, y left, z up, shape (226, 360, 3); NaN = no return."""
    return read_points(data / "3dtk_corridor" / f"scan{index:03d}.3d.gz")


@cache
def mission() -> Scene:
    """The push-broom corridor of the paper's length, registered at the given poses."""
    simulated = simulate_mission("corridor")
    vertical, sensor = simulated.arrays("vertical"), simulated.rig.sensors["vertical"]
    model = SensorModel(sensor.range_sigma_m, bearing_sigma_rad=sensor.bearing_sigma_rad)
    known = (simulated.rig.localisation or LocalisationNoise()).location_covariance()
    read, poses = (vertical.ranges, vertical.angles), vertical.world_T_body_given
    scans = register_scans(*read, poses, model, body_T_sensor=sensor.body_T_sensor, pose_covariances=known)
    segment = partial(segment_scans, scans.points, scans.covariances, viewpoints=scans.viewpoints)
    return Scene(scans.points, segment, 0.03, simulated.arrays("vertical").labels + 1, LEAST_POINTS)


@cache
def labelled(read: Callable, distance_m: float) -> Scene:
    points, sigma, truth = read(DATA)
    return Scene(points, partial(segment_scans, points, sigma=sigma), distance_m, truth)


@cache
def corridor() -> Scene:
    points, model = corridor_scan(DATA, 0), CORRIDOR_SENSOR
    given = {
        "pose_covariances": np.tile(model.scan_covariance(), (len(points), 1, 1)),
        "config": MapperConfig(flatness_m=0.5 * model.surface_sigma_m),
    }
    segment = partial(segment_scans, points, model.covariances(points), viewpoints=(0.0, 0.0, 0.0), **given)
    return Scene(points, segment, 0.05, None)


@cache
def polyhedra(seed: int) -> Scene:
    """A room full of polyhedra, that nothing was tuned on."""
    points, covariances, truth = polyhedra_scan(seed)
    segment = partial(segment_scans, points, covariances, viewpoints=np.zeros(3))
    return Scene(points, segment, 0.005, truth)


def open3d_patches(points: FloatArray) -> list[tuple[FloatArray, Any]]:
    """Open3D's planar patches with normals from 30 neighbours, all else its defaults: plane (n, d) and box."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    return [(np.append(box.R[:, 2], -(box.R[:, 2] @ box.center)), box) for box in cloud.detect_planar_patches()]


def patch_labels(points: FloatArray, patches: list[tuple[FloatArray, Any]]) -> np.ndarray:
    """The patch each point is in, of several the one whose plane is nearest; -1: none. Patches come without points."""
    import open3d

    cloud = open3d.utility.Vector3dVector(points)
    labels, nearest = np.full(len(points), -1), np.full(len(points), np.inf)
    for k, (plane, box) in enumerate(patches):
        inside = np.asarray(box.get_point_indices_within_bounding_box(cloud), dtype=np.int64)
        away = np.abs(points[inside] @ plane[:3] + plane[3])
        closer = away < nearest[inside]
        labels[inside[closer]], nearest[inside[closer]] = k, away[closer]
    return labels


def open3d_ransac(points: FloatArray, distance_m: float) -> np.ndarray:
    """Labels by `segment_plane`, called again on what is left."""
    import open3d

    open3d.utility.random.seed(0)
    labels, left = np.full(len(points), -1), np.arange(len(points))
    for k in range(MOST_PLANES):
        if len(left) < LEAST_POINTS:
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[left]))
        inliers = np.asarray(cloud.segment_plane(distance_m, 3, TRIES)[1], dtype=np.int64)
        if len(inliers) < LEAST_POINTS:
            break
        labels[left[inliers]] = k
        left = np.delete(left, inliers)
    return labels


def correct_detections(labels: np.ndarray, truth: np.ndarray, overlap: float = 0.8) -> int:
    """True planes (labels > 0) that one region covers, and that cover it, at least to the given share.

    References:
        Hoover et al., "An Experimental Comparison of Range Image Segmentation Algorithms", PAMI 1996.
    """
    sizes, count = np.bincount(labels[labels >= 0], minlength=1), 0
    for k in np.unique(truth[truth > 0]):
        mine = truth == k
        shared = np.bincount(labels[mine & (labels >= 0)], minlength=len(sizes))
        best = int(shared.argmax())
        count += bool(shared[best] >= overlap * mine.sum() and shared[best] >= overlap * sizes[best] > 0)
    return count


def score(scene: Scene, labels: np.ndarray, planes: int) -> Row:
    """Hoover's count, share of points in planes, and the share of these that belong to the plane most of theirs do."""
    seen = scene.returns
    represented = 100.0 * (labels >= 0).sum() / seen.sum()
    row: Row = {"correct": None, "planes": planes, "represented, %": float(represented), "purity, %": None}
    if scene.truth is None:
        return row
    truth = np.where(seen, scene.truth, 0)
    sizes = np.bincount(truth[truth > 0])
    truth = np.where(sizes[truth] > scene.wanted_points, truth, 0) if len(sizes) else truth
    wanted = len(np.unique(truth[truth > 0]))
    flat = (labels >= 0) & (scene.truth > 0)
    table = np.zeros((int(labels.max()) + 1, int(scene.truth.max()) + 1), dtype=np.int64)
    np.add.at(table, (labels[flat], scene.truth[flat]), 1)
    row["purity, %"] = 100.0 * float(table.max(axis=1).sum()) / max(int((labels >= 0).sum()), 1)
    return row | {"correct": f"{correct_detections(labels, truth)}/{wanted}"}


def spread(scene: Scene, labels: np.ndarray) -> np.ndarray:
    """Labels of the returns as those of the grid."""
    grid = np.full(scene.points.shape[:2], -1)
    grid[scene.returns] = labels
    return grid


def contenders(build: Callable[[], Scene], repeats: int = 5) -> list:
    """Ours, Open3D's patches and its RANSAC on one scene."""
    scene = build()
    cloud = np.ascontiguousarray(scene.points[scene.returns])
    ours = Task("spplanes", scene.segment, lambda found: score(scene, found[0], len(found[1])), repeats)
    if not find_spec("open3d"):
        return [ours]

    def of_patches(found: list[tuple[FloatArray, Any]]) -> Row:
        return score(scene, spread(scene, patch_labels(cloud, found)), len(found))

    def of_labels(labels: np.ndarray) -> Row:
        return score(scene, spread(scene, labels), int(labels.max()) + 1)

    patches = Task("Open3D, patches", partial(open3d_patches, cloud), of_patches, min(repeats, 3))
    ransac = partial(open3d_ransac, cloud, scene.distance_m)
    return [ours, patches, Task("Open3D, segment_plane", ransac, of_labels, 1)]


def rooms() -> list[Task]:
    """Ours and Open3D's patches on six rooms of polyhedra, counts of all together."""
    scenes = [polyhedra(seed) for seed in range(6)]
    clouds = [np.ascontiguousarray(scene.points[scene.returns]) for scene in scenes]

    def together(rows: list[Row]) -> Row:
        correct = np.sum([[int(n) for n in row["correct"].split("/")] for row in rows], axis=0)
        shares = {name: float(np.mean([row[name] for row in rows])) for name in ("represented, %", "purity, %")}
        return {"correct": f"{correct[0]}/{correct[1]}", "planes": sum(row["planes"] for row in rows), **shares}

    def score_ours(found: list[tuple[np.ndarray, list[Plane]]]) -> Row:
        return together([score(one, labels, len(f)) for one, (labels, f) in zip(scenes, found, strict=True)])

    def score_patches(found: list[list[tuple[FloatArray, Any]]]) -> Row:
        every = zip(scenes, clouds, found, strict=True)
        return together([score(one, spread(one, patch_labels(cloud, f)), len(f)) for one, cloud, f in every])

    ours = Task("spplanes", lambda: [scene.segment() for scene in scenes], score_ours, 2)
    if not find_spec("open3d"):
        return [ours]
    return [ours, Task("Open3D, patches", lambda: [open3d_patches(cloud) for cloud in clouds], score_patches, 1)]


_KINECT = partial(icl_frame, noise_seed=0)
_ALL: dict[str, tuple[str, Case]] = {
    "corridor mission, 1083 scans": ("", partial(contenders, mission, 3)),
    "3dtk_corridor, scan 0": ("3dtk_corridor", partial(contenders, corridor)),
    "icl_labelled": ("icl_labelled", partial(contenders, partial(labelled, icl_frame, 0.005))),
    "icl_labelled with a Kinect's noise": ("icl_labelled", partial(contenders, partial(labelled, _KINECT, 0.03))),
    "synpeb": ("synpeb", partial(contenders, partial(labelled, synpeb_scan, 0.005))),
    "6 rooms of polyhedra, 500 x 500 each": ("", rooms),
}
CASES: dict[str, Case] = {name: case for name, (folder, case) in _ALL.items() if (DATA / folder).is_dir()}


def run(*, short: bool = False) -> list[Row]:
    return measured("benchmarks.scenes", CASES, short=short)
