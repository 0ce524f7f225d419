"""The paper's Tables II and III, measured on the simulated corridor, beside what the paper printed.

Run as ``python -m benchmarks.tables [seeds]``. The paper's times are a Pentium 4's at 1.7 GHz.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from slam.rig import LocalisationNoise
from slam.simulation import Mission, simulate_mission
from spplanes import MapperConfig, Plane, PlaneMapper, segment_scans
from spplanes._check import FloatArray
from spplanes.noise import SensorModel
from spplanes.registration import RegisteredScans, register_scans

#: Scans, points, planes, share represented (%), time (s), memory (KB) as the paper prints them.
PAPER = (
    (2, 722, 3, 100.0, 0.28, 56.7),
    (3, 1083, 3, 99.72, 0.64, 58.8),
    (10, 3610, 4, 99.78, 3.70, 61.9),
    (100, 36100, 40, 99.08, 56.52, 222.4),
    (344, 124128, 233, 98.7, 235.45, 1158.8),
    (1083, 403598, 1742, 95.76, 334.74, 4512.2),
)
#: Errors the paper reports: ceiling height and corridor width, m; ceiling and locker normal, deg.
PAPER_ERRORS = {"height_m": 0.004, "width_m": 0.002, "ceiling_deg": 0.12, "locker_deg": 0.26}
#: A true plane counts when it has more points than this.
LARGE = 200


def corridor_scans(n_scans: int, seed: int = 0) -> Mission:
    """The simulated mission."""
    return simulate_mission("corridor", n_scans=n_scans, seed=seed)


def points_of(mission: Mission) -> RegisteredScans:
    """Points with covariances of the vertical laser at the poses the log gives."""
    scans, sensor = mission.arrays("vertical"), mission.rig.sensors["vertical"]
    model = SensorModel(sensor.range_sigma_m, bearing_sigma_rad=sensor.bearing_sigma_rad)
    noise = mission.rig.localisation or LocalisationNoise()
    return register_scans(
        scans.ranges,
        scans.angles,
        scans.world_T_body_given,
        model,
        body_T_sensor=sensor.body_T_sensor,
        pose_covariances=noise.location_covariance(),
    )


def quality(labels: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Label purity, share of large true planes found (Hoover, 80 %) and share split into several regions.

    A labelled point is pure when its true plane is the one most points of its region have; points of round things have
    none and are never pure.
    """
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    table = np.zeros((len(sizes), int(truth.max()) + 2), dtype=np.int64)
    np.add.at(table, (labels[labels >= 0], truth[labels >= 0] + 1), 1)
    major, pure = table.argmax(axis=1) - 1, table[:, 1:].max(axis=1).sum()
    found, split, large = 0, 0, [t for t in range(int(truth.max()) + 1) if (truth == t).sum() > LARGE]
    for t in large:
        n, shared = (truth == t).sum(), table[:, t + 1]
        best = int(shared.argmax())
        hit = shared[best] >= 0.8 * n and shared[best] >= 0.8 * sizes[best]
        parts = shared[major == t]
        found, split = found + bool(hit), split + bool(not hit and len(parts) > 1 and parts.sum() >= 0.8 * n)
    return {
        "purity_%": 100.0 * pure / max(sizes.sum(), 1),
        "found_%": 100.0 * found / max(len(large), 1),
        "split_%": 100.0 * split / max(len(large), 1),
    }


def table_2(mission: Mission) -> list[dict]:
    """Rows of Table II, scan by scan (`PlaneMapper`) and all at once (`segment_scans`)."""
    registered, truth = points_of(mission), mission.arrays("vertical").labels
    rows = []
    for n_scans, *paper in PAPER:
        if n_scans > len(truth):
            continue
        part = RegisteredScans(*(value[:n_scans] for value in vars(registered).values()))
        for name, job in (("PlaneMapper", _scan_by_scan), ("segment_scans", _all_at_once)):
            start = time.perf_counter()
            labels, n_planes, memory = job(part)
            taken = time.perf_counter() - start
            seen = int(np.isfinite(part.points[..., 0]).sum())
            flat = truth[:n_scans] >= 0
            rows.append(
                {
                    "method": name,
                    "scans": n_scans,
                    "points": seen,
                    "planes": n_planes,
                    "represented_%": 100.0 * (labels >= 0).sum() / seen,
                    "of_flat_%": 100.0 * ((labels >= 0) & flat).sum() / flat.sum(),
                    "time_s": taken,
                    "memory_KB": memory,
                    **quality(labels, truth[:n_scans]),
                    "paper": tuple(paper),
                }
            )
    return rows


def _scan_by_scan(scans: RegisteredScans) -> tuple[np.ndarray, int, float]:
    mapper = PlaneMapper(MapperConfig(keep_labels=True))
    for k in range(len(scans.points)):
        mapper.add_scan(scans.points[k], scans.covariances[k], viewpoint=scans.viewpoints[k])
    return mapper.labels(), len(mapper.planes), mapper.memory_bytes / 1024.0


def _all_at_once(scans: RegisteredScans) -> tuple[np.ndarray, int, float]:
    labels, planes = segment_scans(scans.points, scans.covariances, viewpoints=scans.viewpoints)
    return labels, len(planes), float("nan")


def table_3(seeds: int, n_scans: int = 344) -> list[dict]:
    """Errors of ceiling, walls and lockers over seeds, and the planes' normalised errors (3 is right)."""
    rows = []
    for seed in range(seeds):
        mission = corridor_scans(n_scans, seed)
        planes, truth = _planes_of(mission)
        ceiling, left, right, lockers = _pick(planes, truth)
        floor = max((p for p, _ in truth if p.normal[2] > 0.99), key=lambda p: p.n_points)
        rows.append(
            {
                "height_m": abs(_gap(ceiling[0], floor) - 2.700),
                "width_m": abs(_gap(left[0], right[0]) - 2.268),
                "ceiling_deg": _angle(ceiling[0].normal, ceiling[1].normal),
                "locker_deg": float(np.median([_angle(p.normal, t.normal) for p, t in lockers])),
                "nees": [nees(p, t) for p, t in truth if p.n_points > LARGE],
            }
        )
    return rows


def _planes_of(mission: Mission) -> tuple[list[Plane], list[tuple[Plane, Plane]]]:
    """Planes with the shared pose error, and each with the true plane most of its points are on."""
    scans, labels_true = points_of(mission), mission.arrays("vertical").labels
    noise = mission.rig.localisation or LocalisationNoise()
    spacing = float(np.median(np.linalg.norm(np.diff(scans.scan_origins, axis=0), axis=1)))
    config = replace(MapperConfig(), pose_correlation_scans=noise.correlation_length_m / spacing)
    labels, planes = segment_scans(
        scans.points,
        scans.covariances,
        viewpoints=scans.viewpoints,
        pose_covariances=scans.pose_covariances,
        scan_origins=scans.scan_origins,
        config=config,
    )
    pairs = []
    for k, plane in enumerate(planes):
        under = labels_true[labels == k]
        values, counts = np.unique(under, return_counts=True)
        if values[counts.argmax()] >= 0 and counts.max() > 0.8 * len(under):
            pairs.append((plane, mission.truth.planes[int(values[counts.argmax()])]))
    return planes, pairs


def _pick(planes: list[Plane], pairs: list[tuple[Plane, Plane]]) -> tuple:
    """Ceiling, left and right wall, each with its truth, and all locker fronts."""
    by_size = sorted(pairs, key=lambda pair: -pair[0].n_points)
    ceiling = next(pair for pair in by_size if pair[1].normal[2] < -0.99 and abs(abs(pair[1].d) - 2.7) < 0.01)
    left = next(pair for pair in by_size if pair[1].normal[1] < -0.99 and abs(abs(pair[1].d) - 1.134) < 0.01)
    right = next(pair for pair in by_size if pair[1].normal[1] > 0.99 and abs(abs(pair[1].d) - 1.134) < 0.01)
    lockers = [pair for pair in by_size if abs(pair[1].normal[1]) > 0.99 and abs(abs(pair[1].d) - 1.084) < 0.01]
    return ceiling, left, right, lockers or [right]


def _gap(one: Plane, other: Plane) -> float:
    """Distance between two facing planes, in the middle between what was seen of them, m."""
    middle = 0.5 * (one.centre + other.centre)
    return float(abs(one.distance(middle)) + abs(other.distance(middle)))


def _angle(one: FloatArray, other: FloatArray) -> float:
    """Angle between two normals whatever their sides, deg."""
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(one, other))))))


def nees(plane: Plane, truth: Plane) -> float:
    """Normalised squared error of a plane, chi2 with 3 degrees of freedom when its covariance is honest."""
    x, y, n = plane.frame[:3, :3].T
    m = truth.normal * np.sign(truth.normal @ n)
    slope = m / (m @ n)
    height = (m @ (truth.centre - plane.centre)) / (m @ n)
    error = np.array([height, slope @ x, -(slope @ y)])
    return float(error @ np.linalg.solve(plane.covariance, error))


def run(seeds: int = 20) -> list[dict]:
    """Rows of both tables."""
    rows = table_2(corridor_scans(PAPER[-1][0]))
    errors = table_3(seeds)
    for key, paper in PAPER_ERRORS.items():
        rows.append({"error": key, "median": float(np.median([row[key] for row in errors])), "paper": paper})
    normalised = np.array([value for row in errors for value in row["nees"]])
    rows.append(
        {"error": "nees (3 is right)", "median": float(np.median(normalised)), "mean": float(normalised.mean())}
    )
    return rows


def main() -> None:
    """Print both tables."""
    for row in run(int(sys.argv[1]) if len(sys.argv) > 1 else 20):
        print(
            "  ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
        )


if __name__ == "__main__":
    main()
