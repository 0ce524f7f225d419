"""Readers of the scans that ``benchmarks.scenes`` measures, and Hoover's count."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.io.cloud_folders import clouds_in
from slam.io.clouds import read_cloud
from slam.io.threedtk import read_points
from spplanes._check import FloatArray
from spplanes.clouds.arrange import arrange
from spplanes.noise import DepthCameraModel, SensorModel

#: The tilting SICK of 3dtk_corridor: 1 cm of range noise; its tilt servo jerks from line to line, and drifts.
CORRIDOR_SENSOR = SensorModel(
    range_sigma_m=0.01, scan_shift_sigma_m=0.005, scan_tilt_sigma_rad=0.003, surface_sigma_m=0.02
)
#: The upright laser of pcl_room: 1 cm of range noise; slices tilt by millimetres each; its ranges are off by up to 4 cm
#: depending on the distance, so that a flat ceiling comes out as a bowl.
ROOM_SENSOR = SensorModel(
    range_sigma_m=0.01,
    bearing_sigma_rad=0.003,
    scan_shift_sigma_m=0.003,
    scan_tilt_sigma_rad=0.003,
    surface_sigma_m=0.02,
)
#: Nearer than this that laser sees the robot, m.
ROOM_RANGE_M = 0.8


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
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    points = np.stack(
        ((u - camera[0, 2]) / camera[0, 0] * depth, (v - camera[1, 2]) / camera[1, 1] * depth, depth), axis=-1
    )
    points[depth <= 0.0] = np.nan
    return points, sigma, labels


def synpeb_scan(data: Path) -> tuple[FloatArray, float, np.ndarray]:
    """Points (100, 100, 3), sigma and labels of the SynPEB scan; its residuals about the true planes are about 1 mm."""
    lines = (data / "synpeb" / "test_100.pcd").read_text(encoding="latin1").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("DATA")) + 1
    values = np.loadtxt(lines[start:])
    return values[:, :3].reshape(100, 100, 3), 0.001, values[:, 3].reshape(100, 100).astype(np.int64)


def corridor_scan(data: Path, index: int) -> FloatArray:
    """One scan of the 3DTK corridor, metric, x forward, y left, z up, shape (226, 360, 3); NaN = no return."""
    return read_points(data / "3dtk_corridor" / f"scan{index:03d}.3d.gz")


def room_slices(data: Path, index: int) -> FloatArray:
    """One scan of the room as vertical slices, shape (lines, 181, 3): beams by elevation, every line once."""
    grid = arrange(read_cloud(data / "pcl_room" / f"room_scan{index}.pcd").points)
    grid[np.linalg.norm(grid, axis=-1) < ROOM_RANGE_M] = np.nan
    return grid


def hall_cloud(data: Path, index: int) -> FloatArray:
    """One unorganised cloud of the hall, shape (N, 3)."""
    return read_cloud(clouds_in(data / "balm_hall")[index]).points


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
