"""Driving a plan and recording it: what every sensor read when, what was true, and how that lies on disk."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.io.planes_json import read_planes, write_planes
from slam.io.raw import check_ratio, damage_told
from slam.io.scan_files import in_order
from slam.io.trajectories import Trajectory, read_tum, write_tum
from slam.sensors.log import Event, Log, OdometryReading
from slam.sensors.rig import LocalisationNoise, Rig, Sensor
from slam.sensors.wheel_noise import OdometryNoise
from slam.simulation.robots import BEAMS, HORIZONTAL, Beams, pose_matrices
from slam.simulation.robots import Path as DrivenPath
from slam.simulation.world import NO_PLANE, World
from spplanes._check import FloatArray
from spplanes.plane import Plane
from spplanes.registration import beam_directions

_TRAJECTORY, _PLANES, _LABELS = "trajectory.tum", "planes.json", "labels.npz"


@dataclass(frozen=True, eq=False)
class Truth:
    """What really was where."""

    stamps_ns: np.ndarray
    """Times of the true poses: of every scan and odometry reading, ascending, shape (T,), int64."""
    world_T_body: FloatArray
    """True poses of the robot at those times, shape (T, 4, 4)."""
    planes: list[Plane]
    """The true planes; labels are indices into this list."""
    labels: dict[str, np.ndarray]
    """Plane that each beam hit, by sensor and in the order of its scans, shape (S, B) or (S, F, B), int32; -1: none."""

    @property
    def trajectory(self) -> Trajectory:
        """The true poses."""
        return Trajectory(self.stamps_ns, self.world_T_body)

    def poses_at(self, stamps_ns: np.ndarray) -> FloatArray:
        """True poses (N, 4, 4) at times (N,) of scans or odometry readings; any other time is a ValueError."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        places = np.minimum(np.searchsorted(self.stamps_ns, stamps_ns), len(self.stamps_ns) - 1)
        if not np.array_equal(self.stamps_ns[places], stamps_ns):
            raise ValueError("stamps_ns: expected times of scans or odometry readings of this mission, got another")
        return self.world_T_body[places]

    def visible_in_3d(self) -> set[int]:
        """Indices of the planes that one of the sensors that give 3D points hit more than 200 times.

        These are there to be found: a level laser alone sees lines, not planes.
        """
        seen = [labels[labels >= 0] for name, labels in self.labels.items() if name != HORIZONTAL]
        return {plane for hit in seen for plane in np.flatnonzero(np.bincount(hit) > 200).tolist()}

    def write(self, folder: Path) -> None:
        """Write trajectory.tum, planes.json (spplanes/1; the id is the label) and labels.npz into a folder."""
        write_tum(folder / _TRAJECTORY, self.trajectory)
        write_planes(folder / _PLANES, self.planes)
        with (folder / _LABELS).open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **self.labels)  # type: ignore[arg-type]

    @classmethod
    def read(cls, folder: Path | str) -> Truth:
        """Read what `write` wrote; anything else is a `LogError` naming the file."""
        folder = Path(folder)
        path, planes = read_tum(folder / _TRAJECTORY), read_planes(folder / _PLANES)
        return cls(path.stamps_ns, path.poses, planes, _read_labels(folder / _LABELS))


def _read_labels(path: Path) -> dict[str, np.ndarray]:
    with damage_told(path, "expected arrays of labels as NumPy wrote them, got something else"):
        with zipfile.ZipFile(path) as archive:
            for member in archive.infolist():
                check_ratio(path, member.file_size, member.compress_size)
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def noisy_ranges(ranges: FloatArray, sensor: Sensor, rng: np.random.Generator) -> FloatArray:
    """What the sensor reads of exact ranges: Gaussian noise, quantisation, NaN at and beyond its limits."""
    read = ranges + sensor.range_sigma_m * rng.standard_normal(ranges.shape)
    if sensor.quantisation_m > 0.0:
        read = sensor.quantisation_m * np.round(read / sensor.quantisation_m)
    return np.where((read > sensor.range_min_m) & (read < sensor.range_max_m), read, np.nan)


def drifting_odometry(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Odometry's poses (K, 3) of true poses (K, 3), from the same start: a random walk on calibration errors."""
    steps = relative_motions(poses)
    scale, curvature = rng.standard_normal(2) * (noise.scale_sigma, noise.curvature_sigma_rad_per_m)
    way = np.hypot(steps[:, 0], steps[:, 1])
    values, vectors = np.linalg.eigh(noise.random_covariances(steps))  # singular ones are of a robot that stands
    factors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] @ vectors.transpose(0, 2, 1)
    steps = steps + np.einsum("kij,kj->ki", factors, rng.standard_normal(steps.shape))
    steps = steps + np.column_stack([scale * steps[:, :2], curvature * way])
    heading = poses[0, 2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    moves = np.column_stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]])
    places = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return np.column_stack([places, heading])


def relative_motions(poses: FloatArray) -> FloatArray:
    """Motions (K - 1, 3) between successive poses (K, 3), each in the frame of its first pose."""
    moves, heading = np.diff(poses, axis=0), poses[:-1, 2]
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([c * moves[:, 0] + s * moves[:, 1], -s * moves[:, 0] + c * moves[:, 1], moves[:, 2]])


def localised_poses(
    poses: FloatArray, way_m: FloatArray, noise: LocalisationNoise, rng: np.random.Generator
) -> FloatArray:
    """Poses (K, 3) as a localisation gives them: three Ornstein-Uhlenbeck errors over the ways (K,) driven."""
    errors = rng.standard_normal(poses.shape)
    for k, keep in enumerate(np.exp(-np.diff(way_m) / noise.correlation_length_m), start=1):
        errors[k] = keep * errors[k - 1] + np.sqrt(1.0 - keep**2) * errors[k]
    return poses + errors * np.sqrt(np.diag(noise.covariance()))


#: Time of the first scan, and speed of the robot.
START_NS, SPEED_M_PER_S = 1_000_000_000_000, 0.5
#: Directions of so many beams are held in memory at a time.
BLOCK_BEAMS = 1_000_000


#: Exact ranges and labels.
_Hits = tuple[FloatArray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Plan:
    """Who drives where through what."""

    name: str
    """Name of the world."""
    world: World
    path: DrivenPath
    """The way through it."""
    rig: Rig
    """The robot; its sensors are among `BEAMS`."""
    spacing_m: float
    """Way between two scans of the main sensor, m."""


def record(plan: Plan, n_scans: int, seed: int) -> tuple[Log, Truth]:
    """Drive the plan for `n_scans` scans of the main sensor.

    Time runs in half periods of the main sensor: odometry at each, its scans at the even ones, horizontal scans at
    every eighth, half a period after a main scan. Bearing noise, quantisation and sweeps are those of the rig; a
    sensor's `surface_sigma_m` is not simulated: walls here are flat.
    """
    ticks = np.arange(2 * n_scans - 1)
    stamps = START_NS + ticks * round(plan.spacing_m / SPEED_M_PER_S * 1e9 / 2.0)
    way = ticks.astype(np.float64) * plan.spacing_m / 2.0
    poses = plan.path.at(way)
    children = np.random.SeedSequence(seed).spawn(2 + len(BEAMS))  # no sensor's draws move when another's number does
    wheels, localiser, *lasers = (np.random.default_rng(child) for child in children)
    drifting = pose_matrices(drifting_odometry(poses, plan.rig.odometry, wheels))
    events: list[Event] = [OdometryReading(int(t), pose) for t, pose in zip(stamps, drifting, strict=True)]
    given: FloatArray | None = None
    if plan.rig.localisation is not None:
        given = pose_matrices(localised_poses(poses, way, plan.rig.localisation, localiser))

    world_T_body, labels = pose_matrices(poses), {}
    for (sensor, beams), rng in zip(BEAMS.items(), lasers, strict=True):
        if sensor not in plan.rig.sensors:
            continue
        at = ticks[1::8] if sensor == HORIZONTAL else ticks[::2]
        described = plan.rig.sensors[sensor]
        ranges, hit = _cast(plan, way[at], described, beams, rng.spawn(1)[0])
        read = noisy_ranges(ranges, described, rng)
        labels[sensor] = np.where(np.isnan(read), np.int32(NO_PLANE), hit)
        if beams.angles is None:
            labels[sensor] = labels[sensor].reshape(len(at), *beams.directions.shape[:2])
        for tick, row in zip(at.tolist(), read, strict=True):
            events.append(beams.scan(int(stamps[tick]), sensor, row, None if given is None else given[tick]))
    truth = Truth(stamps, world_T_body, plan.world.planes, labels)
    return Log(in_order(events), Path(f"simulated {plan.name}")), truth


def _cast(plan: Plan, way: FloatArray, sensor: Sensor, beams: Beams, rng: np.random.Generator) -> _Hits:
    """Exact ranges and labels of a sensor at places (S,) on the way, both (S, F B): fan after fan, block by block."""
    block = max(1, BLOCK_BEAMS // (beams.directions.size // 3))
    blocks = [_cast_block(plan, way[k : k + block], sensor, beams, rng) for k in range(0, len(way), block)]
    return np.concatenate([ranges for ranges, _ in blocks]), np.concatenate([labels for _, labels in blocks])


def _cast_block(plan: Plan, way: FloatArray, sensor: Sensor, beams: Beams, rng: np.random.Generator) -> _Hits:
    fans, n_beams, _ = beams.directions.shape
    directions = np.broadcast_to(beams.directions, (len(way), fans, n_beams, 3))
    if sensor.bearing_sigma_rad > 0.0 and beams.angles is not None:
        errors = sensor.bearing_sigma_rad * rng.standard_normal((len(way), n_beams))
        directions = beam_directions((beams.angles + errors).ravel()).reshape(directions.shape)
    normals = np.tile(beams.normals, (len(way), 1))
    if sensor.sweep_s > 0.0 and beams.angles is None:  # from fan to fan, and stamped in the middle
        late_m = SPEED_M_PER_S * sensor.sweep_s * ((np.arange(fans) + 0.5) / fans - 0.5)
        way, directions = (way[:, None] + late_m).ravel(), directions.reshape(-1, n_beams, 3)
    elif sensor.sweep_s > 0.0:  # every beam is a fan of its own, from its own place
        way = (way[:, None] + SPEED_M_PER_S * sensor.sweep_s * np.linspace(0.0, 1.0, n_beams)).ravel()
        directions, normals = directions.reshape(-1, 1, 3), np.repeat(normals, n_beams, axis=0)
    else:
        way, directions = np.repeat(way, fans), directions.reshape(-1, n_beams, 3)
    world_T_sensor = pose_matrices(plan.path.at(way)) @ sensor.body_T_sensor
    rays = directions @ world_T_sensor[:, :3, :3].transpose(0, 2, 1)
    normals = np.einsum("fij,fj->fi", world_T_sensor[:, :3, :3], normals)
    ranges, labels = plan.world.cast(np.ascontiguousarray(world_T_sensor[:, :3, 3]), rays, normals)
    return ranges.reshape(-1, fans * n_beams), labels.reshape(-1, fans * n_beams)
