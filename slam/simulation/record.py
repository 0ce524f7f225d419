"""Driving a plan and recording it: what every sensor read when, and what was true."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.sensors.log import CloudScan, Event, LaserScan, Log, OdometryReading
from slam.sensors.rig import Rig, Sensor
from slam.simulation.noise import drifting_odometry, localised_poses, noisy_ranges
from slam.simulation.path import Path as DrivenPath
from slam.simulation.path import pose_matrices
from slam.simulation.rigs import BEAMS, HORIZONTAL, Beams
from slam.simulation.truth import Truth
from slam.simulation.world import NO_PLANE, World
from spplanes._check import FloatArray
from spplanes.registration import beam_directions

#: Time of the first scan, and speed of the robot.
START_NS, SPEED_M_PER_S = 1_000_000_000_000, 0.5
#: A horizontal scan is taken after every so many vertical ones, half a period late.
HORIZONTAL_EVERY = 4
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
    """The world."""
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
    wheels, localiser, *lasers = _streams(seed, 2 + len(BEAMS))
    drifting = pose_matrices(drifting_odometry(poses, plan.rig.odometry, wheels))
    events: list[Event] = [OdometryReading(int(t), pose) for t, pose in zip(stamps, drifting, strict=True)]
    given: FloatArray | None = None
    if plan.rig.localisation is not None:
        given = pose_matrices(localised_poses(poses, way, plan.rig.localisation, localiser))

    world_T_body, labels = pose_matrices(poses), {}
    for (sensor, beams), rng in zip(BEAMS.items(), lasers, strict=True):
        if sensor not in plan.rig.sensors:
            continue
        at = ticks[1 :: 2 * HORIZONTAL_EVERY] if sensor == HORIZONTAL else ticks[::2]
        described = plan.rig.sensors[sensor]
        ranges, hit = _cast(plan, way[at], described, beams, rng.spawn(1)[0])
        read = noisy_ranges(ranges, described, rng)
        labels[sensor] = np.where(np.isnan(read), np.int32(NO_PLANE), hit)
        if beams.angles is None:
            labels[sensor] = labels[sensor].reshape(len(at), *beams.directions.shape[:2])
        poses_of_scans = [None] * len(at) if given is None else list(given[at])
        for k, (tick, pose) in enumerate(zip(at.tolist(), poses_of_scans, strict=True)):
            events.append(_scan(int(stamps[tick]), sensor, beams, read[k], pose))
    events.sort(key=lambda event: (event.stamp_ns, not isinstance(event, OdometryReading)))
    truth = Truth(stamps, world_T_body, plan.world.planes, labels)
    return Log(events, Path(f"simulated {plan.name}")), truth


def _scan(
    stamp_ns: int, sensor: str, beams: Beams, ranges: FloatArray, pose: FloatArray | None
) -> LaserScan | CloudScan:
    if beams.angles is not None:
        return LaserScan(stamp_ns, sensor, ranges, beams.angles, pose)
    return CloudScan(stamp_ns, sensor, ranges.reshape(beams.directions.shape[:2])[..., None] * beams.directions)


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
    if sensor.sweep_s > 0.0:  # every beam is a fan of its own, from its own place
        way = (way[:, None] + SPEED_M_PER_S * sensor.sweep_s * np.linspace(0.0, 1.0, n_beams)).ravel()
        directions, normals = directions.reshape(-1, 1, 3), np.repeat(normals, n_beams, axis=0)
    else:
        way, directions = np.repeat(way, fans), directions.reshape(-1, n_beams, 3)
    world_T_sensor = pose_matrices(plan.path.at(way)) @ sensor.body_T_sensor
    rays = directions @ world_T_sensor[:, :3, :3].transpose(0, 2, 1)
    normals = np.einsum("fij,fj->fi", world_T_sensor[:, :3, :3], normals)
    ranges, labels = plan.world.cast(np.ascontiguousarray(world_T_sensor[:, :3, 3]), rays, normals)
    return ranges.reshape(-1, fans * n_beams), labels.reshape(-1, fans * n_beams)


def _streams(seed: int, count: int) -> list[np.random.Generator]:
    """Independent generators, so that no sensor's draws move when another's number changes."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
