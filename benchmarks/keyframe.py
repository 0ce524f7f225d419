"""A keyframe of 75,000 points, stage by stage: from the scan to the graph.

Run as ``python -m benchmarks.keyframe``. One thread, processor time, medians over the keyframes after the first few:
kernels are loaded then and the map has its planes. In the simulated hall positions and planes are held against the
truth; of the real sets nothing is surveyed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks._measure import PROJECT, Row
from benchmarks._own_process import in_own_process
from benchmarks._table import plain
from slam.config import SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.frontend.measurement import for_points, for_sensor, usable_points
from slam.io.clouds import read_cloud
from slam.io.clouds.cloud import grid_of
from slam.io.default_rigs import cloud_rig, threedtk_rig
from slam.io.load import load
from slam.planeslam import PlaneSlam
from slam.sensors.log import CloudScan, Log, OdometryReading
from slam.sensors.rig import OdometryNoise, Rig, Sensor
from slam.sensors.scan_noise import line_tilt_covariances, model_of
from slam.simulation.buildings import hall, hall_path
from slam.simulation.path import pose_matrices
from slam.simulation.record import drifting_odometry, noisy_ranges
from slam.timing import StageClock
from spplanes import segment_scans
from spplanes._check import FloatArray
from spplanes.clouds.arrange import arrange

DATA = PROJECT.parent / "shared" / "data"
#: Way between two keyframes, m; keyframes that are not counted.
STEP_M, WARM_UP = 0.5, 5
#: The sensor's height in the simulated hall, m, and its name.
HEIGHT_M, SENSOR = 0.8, "cloud"
#: Stages of the estimator that have a column of their own; what remains of it is in the sum.
STAGES = {"associate": "associate ms", "update": "update ms", "optimise": "iSAM2 ms"}


@dataclass(frozen=True, eq=False)
class Scene:
    """Scans, and what is known of them."""

    log: Log
    """Scans and odometry."""
    rig: Rig
    """The sensor."""
    truth: FloatArray | None = None
    """True positions of the sensor at the scans, shape (K, 3), m."""


def rings() -> FloatArray:
    """Directions of a spinning lidar's 64 rings, from -30 to 60 deg, at 1172 azimuths, shape (64, 1172, 3)."""
    elevation = np.deg2rad(np.linspace(60.0, -30.0, 64))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, 1172, endpoint=False)[None]
    level = np.cos(elevation)
    return np.stack(np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=-1)


def tilted_fans(tilts: FloatArray) -> FloatArray:
    """Directions of a level 2D laser of 361 beams that tilts about y by angles (S,), rad, shape (S, 361, 3)."""
    beams = np.deg2rad(np.linspace(-90.0, 90.0, 361))[None]
    c, s = np.cos(tilts)[:, None], np.sin(tilts)[:, None]
    return np.stack(np.broadcast_arrays(c * np.cos(beams), np.sin(beams), -s * np.cos(beams)), axis=-1)


def spinning_hall(keyframes: int, *, shuffled: bool = False, seed: int = 0) -> Scene:
    """A spinning lidar in the hall, as range images or as clouds in no order."""
    sensor = Sensor(kind="cloud", range_sigma_m=0.015, range_max_m=60.0)
    rng, directions = np.random.default_rng(seed), rings()

    def scan(pose: FloatArray) -> FloatArray:
        points = _seen(directions, directions, pose, sensor, rng)
        flat = points.reshape(-1, 3)
        return rng.permutation(flat[np.isfinite(flat).all(axis=1)]) if shuffled else points

    return _driven(keyframes, sensor, OdometryNoise(), scan, rng)


def tilting_hall(keyframes: int, seed: int = 0) -> Scene:
    """A tilting laser in the hall whose servo errs as the default rig of 3DTK folders says: in blocks of lines."""
    sensor = next(iter(threedtk_rig().sensors.values())).model_copy(
        update={"surface_sigma_m": 0.0, "range_max_m": 60.0}
    )
    sensor = sensor.model_copy(update={"tilt_sigma_rad": 0.003})
    rng, tilts = np.random.default_rng(seed), np.linspace(np.deg2rad(-70.0), np.deg2rad(34.0), 208)

    def scan(pose: FloatArray) -> FloatArray:
        blocks = rng.standard_normal(len(tilts)) * sensor.tilt_sigma_rad
        off = blocks[np.arange(len(tilts)) // int(sensor.tilt_correlation_lines)]
        return _seen(tilted_fans(tilts + off), tilted_fans(tilts), pose, sensor, rng)

    return _driven(keyframes, sensor, OdometryNoise(), scan, rng)


def recorded(name: str, keyframes: int) -> Scene:
    """The first scans of a folder of the shared data, in memory."""
    log, rig = load(DATA / name)
    scans = [CloudScan(scan.stamp_ns, scan.sensor, scan.points) for scan in log.scans() if isinstance(scan, CloudScan)]
    return Scene(Log([*log.odometry, *scans[:keyframes]], DATA / name), rig)


def clouds(name: str, keyframes: int) -> Scene:
    """The first clouds of a folder of the shared data, as they are in their files."""
    paths = sorted((DATA / name).glob("*.pcd"))[:keyframes]
    rig = cloud_rig()
    [sensor] = rig.sensors
    scans = [CloudScan(k * 10**9, sensor, read_cloud(path).points) for k, path in enumerate(paths)]
    return Scene(Log([*scans], DATA / name), rig)


def _seen(
    truly: FloatArray, nominal: FloatArray, world_T_sensor: FloatArray, sensor: Sensor, rng: np.random.Generator
) -> FloatArray:
    """Points (S, B, 3) that beams of true directions meet, placed where the sensor believes they went."""
    rays = truly @ world_T_sensor[:3, :3].T
    origins = np.tile(world_T_sensor[:3, 3], (len(truly), 1))
    ranges, _ = _HALL.cast(origins, np.ascontiguousarray(rays), np.zeros((len(truly), 3)))
    return noisy_ranges(ranges, sensor, rng)[..., None] * nominal


_HALL = hall()


def _driven(
    keyframes: int,
    sensor: Sensor,
    noise: OdometryNoise,
    scan: Callable[[FloatArray], FloatArray],
    rng: np.random.Generator,
) -> Scene:
    """A drive through the hall with a scan every half metre; the body is the sensor."""
    way = np.linspace(0.0, (keyframes - 1) * STEP_M, keyframes)
    poses = hall_path(1).at(way)
    truth, wheels = pose_matrices(poses), pose_matrices(drifting_odometry(poses, noise, rng))
    truth[:, 2, 3] = HEIGHT_M
    events = []
    for k in range(keyframes):
        events += [OdometryReading(k * 10**9, wheels[k]), CloudScan(k * 10**9, SENSOR, scan(truth[k]))]
    return Scene(Log(events, Path("hall")), Rig(sensors={SENSOR: sensor}, odometry=noise), truth[:, :3, 3])


def row_of(scene: Scene) -> Row:
    """Median processor time of every stage, and how good the result is."""
    config, clock, columns = SlamConfig(), StageClock(now=time.process_time), []
    slam = PlaneSlam(config)
    slam.clock = slam.backend.clock = clock
    frames = keyframes_of(scene.log, scene.rig, config)
    scans = [scan for scan in scene.log.scans() if isinstance(scan, CloudScan)]
    for _ in scans:
        before, start = dict(clock.seconds), time.process_time()
        keyframe = next(frames)
        measured = time.process_time()
        slam.add_keyframe(keyframe)
        done = time.process_time()
        spent = {name: clock.seconds.get(stage, 0.0) - before.get(stage, 0.0) for stage, name in STAGES.items()}
        columns.append(
            {"measure ms": measured - start} | spent | {"estimate ms": done - measured, "keyframe ms": done - start}
        )
    steady = columns[min(WARM_UP, len(columns) // 2) :]
    times = {name: 1e3 * float(np.median([column[name] for column in steady])) for name in columns[0]}
    apart = {name: 1e3 * value for name, value in _stages_of_measuring(scans[-1], scene.rig, config).items()}
    points = int(np.median([np.isfinite(scan.points[..., 0]).sum() for scan in scans[-3:]]))
    return {"points": points, "keyframes": len(scans), **_accuracy(slam, scene), **apart, **times}


def _stages_of_measuring(scan: CloudScan, rig: Rig, config: SlamConfig) -> dict[str, float]:
    """Arranging and segmenting alone, s: parts of measuring."""
    sensor = rig.sensors[scan.sensor]
    points = usable_points(scan.points, sensor)
    grid = arrange(points, grid_of(sensor))
    noise = model_of(sensor).covariances(grid)
    find = partial(
        segment_scans,
        config=for_points(for_sensor(config.mapper, sensor), grid),
        viewpoints=np.zeros(3),
        pose_covariances=line_tilt_covariances(sensor, len(grid)),
    )
    return {
        "arrange ms": _median_s(lambda: arrange(points, grid_of(sensor))),
        "segment ms": _median_s(lambda: find(grid, noise)),
    }


def _median_s(work: Callable[[], object], repeats: int = 5) -> float:
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return float(np.median(taken))


def _accuracy(slam: PlaneSlam, scene: Scene) -> Row:
    """Position of the last keyframe and planes against the truth, in the frame of the first pose."""
    planes = slam.planes
    if scene.truth is None:
        return {"planes": len(planes), "position mm": None, "on a true plane": None, "off it, mm": None}
    from slam.evaluation import match_planes

    start = np.eye(4)
    start[:3, 3] = scene.truth[0]
    away = slam.trajectory.poses[:, :3, 3] + scene.truth[0] - scene.truth
    matches = match_planes([one.plane.transform(start) for one in planes], _HALL.planes)
    return {
        "planes": len(planes),
        "position mm": 1e3 * float(np.sqrt((away**2).sum(axis=1).mean())),
        "on a true plane": len(matches),
        "off it, mm": 1e3 * float(np.median([abs(match.distance_m) for match in matches])) if matches else None,
    }


_CASES: dict[str, tuple[str, Callable[[int], Scene]]] = {
    "hall, range images of 64 x 1172": ("", spinning_hall),
    "hall, tilting laser of 208 x 361": ("", tilting_hall),
    "hall, clouds without order": ("", partial(spinning_hall, shuffled=True)),
    "3dtk_corridor, 226 x 360": ("3dtk_corridor", partial(recorded, "3dtk_corridor")),
    "balm_hall, without odometry": ("balm_hall", partial(clouds, "balm_hall")),
}


def run(*, short: bool = False) -> list[Row]:
    """A row for each kind of scan that is there."""
    count = 12 if short else 30
    return [
        {"scans": name, **in_own_process(partial(row_of_case, name, count))}
        for name, (folder, _) in _CASES.items()
        if not folder or (DATA / folder).is_dir()
    ]


def row_of_case(name: str, count: int) -> Row:
    """The row of a case, of so many keyframes."""
    return row_of(_CASES[name][1](count))


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
