"""The paper's Tables II and III, measured on the simulated corridor, beside what the paper printed.

Run as ``python -m benchmarks.tables``. The paper's times are a Pentium 4's at 1.7 GHz.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np

from benchmarks._measure import MEMORY, WALL, Case, Peer, Row, Task, measured
from benchmarks._table import plain
from slam.sensors.rig import LocalisationNoise
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
PAPER_ERRORS = {"height, mm": 4.0, "width, mm": 2.0, "ceiling, deg": 0.12, "lockers, deg": 0.26}
#: Missions of Table III, and their scans.
SEEDS, SEED_SCANS = 20, 344
#: A true plane counts when it has more points than this.
LARGE = 200


@cache
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
        "purity, %": 100.0 * float(pure) / max(int(sizes.sum()), 1),
        "found, %": 100.0 * found / max(len(large), 1),
        "split, %": 100.0 * split / max(len(large), 1),
    }


Found = tuple[np.ndarray, int, float | None]


def scan_by_scan(scans: RegisteredScans) -> Found:
    """The paper's way: labels, planes, size of the map (KB)."""
    mapper = PlaneMapper(MapperConfig(keep_labels=True))
    for k in range(len(scans.points)):
        mapper.add_scan(scans.points[k], scans.covariances[k], viewpoint=scans.viewpoints[k])
    return mapper.labels(), len(mapper.planes), mapper.memory_bytes / 1024.0


def all_at_once(scans: RegisteredScans) -> Found:
    """Labels, planes."""
    labels, planes = segment_scans(scans.points, scans.covariances, viewpoints=scans.viewpoints)
    return labels, len(planes), None


def score_2(scans: RegisteredScans, truth: np.ndarray, found: Found) -> Row:
    """Columns of Table II, and from truth how pure and how whole the planes are."""
    labels, n_planes, map_kb = found
    flat = truth >= 0
    return {
        "planes": n_planes,
        "represented, %": 100.0 * float((labels >= 0).sum() / np.isfinite(scans.points[..., 0]).sum()),
        "of flat, %": 100.0 * float(((labels >= 0) & flat).sum() / flat.sum()),
        **quality(labels, truth),
        "map KB": map_kb,
    }


def table_2(n_scans: int) -> list[Task | Peer]:
    """A row of Table II, scan by scan (`PlaneMapper`) and all at once (`segment_scans`), from registered scans on."""
    mission = corridor_scans(PAPER[-1][0])
    scans = RegisteredScans(*(value[:n_scans] for value in vars(points_of(mission)).values()))
    score = partial(score_2, scans, mission.arrays("vertical").labels[:n_scans])
    _, _, planes, represented, seconds, map_kb = next(row for row in PAPER if row[0] == n_scans)
    printed = {"planes": planes, "represented, %": represented, WALL: 1e3 * seconds, "map KB": map_kb, MEMORY: None}
    repeats = 9 if n_scans < 100 else 3
    return [
        Task("PlaneMapper", partial(scan_by_scan, scans), score, repeats=repeats),
        Task("segment_scans", partial(all_at_once, scans), score, repeats=repeats),
        Peer("the paper", lambda _: dict(printed)),
    ]


def errors(seed: int) -> dict[str, float | list[float]]:
    """Errors of ceiling, walls and lockers of one mission, and the planes' normalised errors."""
    planes, truth = _planes_of(corridor_scans(SEED_SCANS, seed))
    ceiling, left, right, lockers = _pick(planes, truth)
    floor = max((p for p, _ in truth if p.normal[2] > 0.99), key=lambda p: p.n_points)
    return {
        "height, mm": 1e3 * abs(_gap(ceiling[0], floor) - 2.700),
        "width, mm": 1e3 * abs(_gap(left[0], right[0]) - 2.268),
        "ceiling, deg": _angle(ceiling[0].normal, ceiling[1].normal),
        "lockers, deg": float(np.median([_angle(p.normal, t.normal) for p, t in lockers])),
        "NEES": [nees(p, t) for p, t in truth if p.n_points > LARGE],
    }


def score_3(found: list[dict[str, float | list[float]]]) -> Row:
    """Medians over the missions; normalised errors of all their large planes, 3 is right."""
    every = np.concatenate([one["NEES"] for one in found])
    medians = {name: float(np.median([one[name] for one in found])) for name in PAPER_ERRORS}
    return {**medians, "NEES (3), mean": float(every.mean()), "NEES (2.37), median": float(np.median(every))}


def table_3(seeds: int = SEEDS) -> list[Task | Peer]:
    """Table III: medians over seeded missions, which are simulated beforehand."""
    for seed in range(seeds):
        corridor_scans(SEED_SCANS, seed)
    return [
        Task("segment_scans", lambda: [errors(seed) for seed in range(seeds)], score_3, repeats=1),
        Peer("the paper", lambda _: {**PAPER_ERRORS, MEMORY: None}),
    ]


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


CASES: dict[str, Case] = {
    **{f"II: {row[0]} scans, {row[1]} points in the paper": partial(table_2, row[0]) for row in PAPER},
    f"III: {SEEDS} missions of {SEED_SCANS} scans": table_3,
}


def run(*, short: bool = False) -> list[Row]:
    """Rows of both tables, the paper's below ours."""
    return measured("benchmarks.tables", CASES, short=short)


def main() -> None:
    """Print both tables."""
    print(plain(run()))


if __name__ == "__main__":
    main()
