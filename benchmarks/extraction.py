"""Plane extraction beside Open3D on the same points, in one run: quality by Hoover's count, time as a ratio.

Run as ``python -m benchmarks.extraction [FOLDER OF REAL DATA]``. Medians of repeats, kernels warmed up. Both use all
cores they find; NUMBA_NUM_THREADS=1 keeps this library on one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks._boxes import polyhedra_scan
from benchmarks._scans import (
    CORRIDOR_SENSOR,
    HALL_SENSOR,
    ROOM_SENSOR,
    correct_detections,
    corridor_scan,
    hall_cloud,
    icl_frame,
    room_slices,
    synpeb_scan,
)
from spplanes import MapperConfig, PlaneMapper, segment_scans
from spplanes._check import FloatArray

__all__ = [
    "CORRIDOR_SENSOR",
    "HALL_SENSOR",
    "ROOM_SENSOR",
    "correct_detections",
    "corridor_scan",
    "hall_cloud",
    "icl_frame",
    "room_slices",
    "run",
    "synpeb_scan",
]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
REPEATS = 5


def run(data: Path = DATA) -> list[dict]:
    """Rows of measurements: every labelled frame that is there, the simulated mission, and steady state."""
    rows = []
    if (data / "icl_labelled").is_dir():
        rows.append(_frame("icl_labelled 640x480", *icl_frame(data)))
        rows.append(_frame("the same + Kinect noise", *icl_frame(data, 0)))
    if (data / "synpeb").is_dir():
        rows.append(_frame("synpeb 100x100", *synpeb_scan(data)))
    return [*rows, _polyhedra(), *_mission(), _steady()]


def _frame(name: str, points: FloatArray, sigma: FloatArray | float, truth: np.ndarray) -> dict:
    labels, planes = segment_scans(points, sigma=sigma)
    ours, theirs = _together(lambda: segment_scans(points, sigma=sigma), lambda: _open3d_patches(points))
    return {
        "what": name,
        "correct": f"{correct_detections(labels, truth)}/{len(np.unique(truth[truth > 0]))}",
        "planes": len(planes),
        "ours_ms": ours,
        "open3d_ms": theirs,
        "ratio": ours / theirs if theirs else None,
    }


def _polyhedra(n_scans: int = 6) -> dict:
    """Rooms of polyhedra, 500 x 500, that nothing was tuned on."""
    scans = [polyhedra_scan(seed) for seed in range(n_scans)]
    found = [segment_scans(points, noise, viewpoints=np.zeros(3)) for points, noise, _ in scans]
    correct = sum(correct_detections(labels, scan[2]) for (labels, _), scan in zip(found, scans, strict=True))
    points, noise, _ = scans[0]
    ours, theirs = _together(
        lambda: segment_scans(points, noise, viewpoints=np.zeros(3)), lambda: _open3d_patches(points), repeats=3
    )
    return {
        "what": f"{n_scans} rooms of polyhedra 500x500 (time: of one)",
        "correct": f"{correct}/{sum(len(np.unique(truth)) for _, _, truth in scans)}",
        "planes": sum(len(planes) for _, planes in found),
        "ours_ms": ours,
        "open3d_ms": theirs,
        "ratio": ours / theirs if theirs else None,
    }


def _mission(n_scans: int = 1083) -> list[dict]:
    """The push-broom mission from ranges and poses to planes with covariance and outlines."""
    from benchmarks.tables import corridor_scans, points_of

    scans = corridor_scans(n_scans)
    registered = points_of(scans)

    def all_at_once() -> None:
        r = points_of(scans)
        segment_scans(r.points, r.covariances, viewpoints=r.viewpoints)

    def scan_by_scan() -> None:
        r, mapper = points_of(scans), PlaneMapper()
        for k in range(len(r.points)):
            mapper.add_scan(r.points[k], r.covariances[k], viewpoint=r.viewpoints[k])
        assert_planes = mapper.planes
        del assert_planes

    rows = []
    for name, job in (("segment_scans", all_at_once), ("PlaneMapper", scan_by_scan)):
        job()
        ours, theirs = _together(job, lambda: _open3d_patches(registered.points), repeats=3)
        row = {"what": f"mission of {n_scans} scans, {name}", "correct": "", "planes": ""}
        rows.append(row | {"ours_ms": ours, "open3d_ms": theirs, "ratio": ours / theirs if theirs else None})
    return rows


def _steady(n_scans: int = 10_000, n_beams: int = 121) -> dict:
    """Time per scan of the last tenth of a long way beside the first."""
    rng, angles = np.random.default_rng(0), np.linspace(-np.pi / 2, np.pi / 2, n_beams)
    u = np.column_stack((np.zeros(n_beams), np.sin(angles), np.cos(angles)))
    ranges = np.minimum(1.0 / np.abs(u[:, 1]).clip(1e-9), 1.5 / u[:, 2].clip(1e-9))
    covariances = 1e-4 * u[:, :, None] * u[:, None, :] + 1e-8 * np.eye(3)
    mapper, taken = PlaneMapper(MapperConfig(outline_cell_m=0.5)), np.empty(n_scans)
    for k in range(n_scans):
        points = (ranges + 0.01 * rng.standard_normal(n_beams))[:, None] * u + [0.03 * (k % 500), 0.0, 0.0]
        start = time.perf_counter()
        mapper.add_scan(points, covariances)
        taken[k] = time.perf_counter() - start
    strip = mapper.config.strip_scans
    per_scan = taken[: n_scans // strip * strip].reshape(-1, strip).mean(axis=1)
    tenth = len(per_scan) // 10
    first, last = np.median(per_scan[1 : tenth + 1]), np.median(per_scan[-tenth:])
    return {
        "what": "add_scan, mean of a strip: last tenth of 10,000 beside the first",
        "correct": "",
        "planes": len(mapper.planes),
        "ours_ms": 1e3 * last,
        "open3d_ms": None,
        "ratio": last / first,
    }


def _together(
    ours: Callable[[], object], theirs: Callable[[], object], repeats: int = REPEATS
) -> tuple[float, float | None]:
    """Median milliseconds of both, taken in turn; None where Open3D is not installed."""
    taken: tuple[list[float], list[float]] = ([], [])
    try:
        theirs()
    except ImportError:
        theirs = None  # type: ignore[assignment]
    for _ in range(repeats):
        for job, times in zip((ours, theirs), taken, strict=True):
            if job is not None:
                start = time.perf_counter()
                job()
                times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken[0])), float(np.median(taken[1])) if taken[1] else None


def _open3d_patches(points: FloatArray) -> object:
    """Open3D's planar patches with normals from 30 neighbours, all other settings its defaults."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[np.isfinite(points).all(axis=-1)]))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    return cloud.detect_planar_patches()


def main() -> None:
    """Print the table."""
    rows = run(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA)
    print(f"{'what':68}{'correct':>8}{'planes':>8}{'ours ms':>10}{'Open3D ms':>11}{'ratio':>8}")
    for row in rows:
        theirs = "" if row["open3d_ms"] is None else f"{row['open3d_ms']:.1f}"
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.3f}"
        print(f"{row['what']:68}{row['correct']:>8}{row['planes']!s:>8}{row['ours_ms']:>10.2f}{theirs:>11}{ratio:>8}")


if __name__ == "__main__":
    main()
