"""Simulated missions: a world, a way through it, a robot with its sensors, and the truth about all of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.io.log import Event, LaserScan, Log, OdometryReading
from slam.rig import LocalisationNoise, Mount, OdometryNoise, Rig, Sensor
from slam.simulation.corridor import corridor
from slam.simulation.noise import drifting_odometry, localised_poses, noisy_ranges
from slam.simulation.path import Path as DrivenPath
from slam.simulation.path import pose_matrices
from slam.simulation.raycast import scan_directions
from slam.simulation.world import World
from spplanes._check import FloatArray
from spplanes.plane import Plane

#: Names of the two lasers of every push-broom mission.
HORIZONTAL, VERTICAL = "horizontal", "vertical"
#: Scans of the paper's whole corridor, and the way between two of them, m.
PAPER_SCANS, PAPER_SPACING_M = 1083, 0.027
#: Time of the first scan and speed of the robot.
START_NS, SPEED_M_PER_S = 1_000_000_000_000, 0.5
#: A horizontal scan is taken after every so many vertical ones, half a period late.
HORIZONTAL_EVERY = 4

#: Bearings of the beams, rad: 361 over 180 deg as in the paper; the two opposing horizontal lasers as one of 360 deg.
_ANGLES = {
    VERTICAL: np.deg2rad(np.arange(-240, 121) * 0.5),
    HORIZONTAL: np.deg2rad(np.arange(-360, 360) * 0.5),
}


def paper_rig() -> Rig:
    """The robot of the paper: a level 360 deg laser for lines, a vertical push-broom laser for 3D, drifting wheels.

    The vertical laser scans the plane across the robot, 0.4 m above the floor: its x axis points up, y to the left.
    Its 180 deg are turned 30 deg to the right (bearings -120 to 60 deg), so that they reach from a strip of floor on
    the right over the ceiling to the upper left wall: all four sides of a corridor in every scan.
    """
    common = {"range_sigma_m": 0.015, "range_max_m": 40.0}
    level = Mount(xyz_m=(0.0, 0.0, 0.3))
    upright = Mount(xyz_m=(0.0, 0.0, 0.4), rpy_deg=(0.0, -90.0, 0.0))
    return Rig(
        sensors={
            HORIZONTAL: Sensor(kind="line", body_T_sensor=level, record="ROBOTLASER1", **common),
            VERTICAL: Sensor(kind="slice", body_T_sensor=upright, record="ROBOTLASER2", **common),
        },
        odometry=OdometryNoise(),
        localisation=LocalisationNoise(),
    )


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
    """Plane that each beam hit, by sensor, shape (S, B), int32; -1: none."""

    def poses_at(self, stamps_ns: np.ndarray) -> FloatArray:
        """True poses (N, 4, 4) at times (N,) of scans or odometry readings; any other time is a ValueError."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        places = np.minimum(np.searchsorted(self.stamps_ns, stamps_ns), len(self.stamps_ns) - 1)
        if not np.array_equal(self.stamps_ns[places], stamps_ns):
            raise ValueError("stamps_ns: expected times of scans or odometry readings of this mission, got another")
        return self.world_T_body[places]


@dataclass(frozen=True, eq=False)
class ScanArrays:
    """All scans of one 2D laser of a mission as arrays."""

    stamps_ns: np.ndarray
    """Times, shape (S,), int64."""
    ranges: FloatArray
    """Measured ranges, shape (S, B), m; NaN = no return."""
    angles: FloatArray
    """Bearings, shape (B,), rad."""
    world_T_sensor: FloatArray
    """True poses of the sensor, shape (S, 4, 4)."""
    world_T_body_given: FloatArray
    """Poses of the robot as the log gives them, with the localisation's error, shape (S, 4, 4)."""
    labels: np.ndarray
    """True plane of each beam, shape (S, B), int32; -1: none."""

    def sensor_points(self) -> FloatArray:
        """Measured points in the sensor frame, shape (S, B, 3), m."""
        return self.ranges[..., None] * scan_directions(self.angles)


@dataclass(frozen=True, eq=False)
class Mission:
    """A simulated mission: what the robot recorded, what is known of the robot, and the truth."""

    log: Log
    """The sensors' data."""
    rig: Rig
    """Sensors, mounts and the noise models the data were drawn from."""
    truth: Truth
    """True poses, planes and labels."""

    def arrays(self, sensor: str) -> ScanArrays:
        """The scans of one 2D laser as arrays."""
        scans = [scan for scan in self.log.scans(sensor) if isinstance(scan, LaserScan)]
        if not scans:
            raise ValueError(f"sensor: expected a 2D laser of the mission, got {sensor!r}")
        stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
        poses = self.truth.poses_at(stamps)
        return ScanArrays(
            stamps_ns=stamps,
            ranges=np.array([scan.ranges for scan in scans]),
            angles=scans[0].angles,
            world_T_sensor=poses @ self.rig.sensors[sensor].body_T_sensor,
            world_T_body_given=np.array(
                [p if s.world_T_body is None else s.world_T_body for s, p in zip(scans, poses, strict=True)]
            ),
            labels=self.truth.labels[sensor],
        )


def simulate_mission(world: str, *, n_scans: int | None = None, seed: int = 0, laps: int = 1) -> Mission:
    """Drive the push-broom robot through a world and record what its sensors read.

    Args:
        world: "corridor".
        n_scans: number of vertical scans; None: the paper's 1083 in the corridor.
        seed: of all noise; the world itself is always the same. Equal arguments give equal missions, bit for bit.
        laps: times round a world that is a loop.

    Raises:
        ValueError: an unknown world, or fewer than two scans.
    """
    if world != "corridor":
        raise ValueError(f"world: expected 'corridor', got {world!r}")
    n_scans = PAPER_SCANS if n_scans is None else int(n_scans)
    if n_scans < 2:
        raise ValueError(f"n_scans: expected at least 2, got {n_scans}")
    way_m = (n_scans - 1) * PAPER_SPACING_M
    path = DrivenPath.weaving(way_m)
    return _record(world, corridor(way_m), path, paper_rig(), n_scans=n_scans, spacing_m=PAPER_SPACING_M, seed=seed)


def _record(
    name: str, world: World, path: DrivenPath, rig: Rig, *, n_scans: int, spacing_m: float, seed: int
) -> Mission:
    """Run along the path in half periods: odometry at each, vertical scans at the even, horizontal at some odd ones."""
    ticks = np.arange(2 * n_scans - 1)
    period_ns = round(spacing_m / SPEED_M_PER_S * 1e9)
    stamps = START_NS + ticks * (period_ns // 2)
    way = np.linspace(0.0, (n_scans - 1) * spacing_m, len(ticks))
    poses = path.at(way)
    ticks_of = {VERTICAL: ticks[::2], HORIZONTAL: ticks[1 :: 2 * HORIZONTAL_EVERY]}
    wheels, localiser, *lasers = _streams(seed, 2 + len(ticks_of))

    odometry = pose_matrices(drifting_odometry(poses, rig.odometry, wheels))
    given = pose_matrices(poses)
    if rig.localisation is not None:
        given = pose_matrices(localised_poses(poses, way, rig.localisation, localiser))
    events: list[Event] = [OdometryReading(int(t), T) for t, T in zip(stamps, odometry, strict=True)]
    world_T_body, labels = pose_matrices(poses), {}
    for (sensor, at), rng in zip(ticks_of.items(), lasers, strict=True):
        ranges, labels[sensor] = _scan(world, world_T_body[at] @ rig.sensors[sensor].body_T_sensor, _ANGLES[sensor])
        read = noisy_ranges(ranges, rig.sensors[sensor], rng)
        labels[sensor] = np.where(np.isnan(read), np.int32(-1), labels[sensor])
        events += [
            LaserScan(int(stamps[k]), sensor, r, _ANGLES[sensor], given[k]) for k, r in zip(at, read, strict=True)
        ]
    events.sort(key=lambda event: (event.stamp_ns, not isinstance(event, OdometryReading)))
    truth = Truth(stamps, world_T_body, world.planes, labels)
    return Mission(Log(events, Path(f"simulated {name}")), rig, truth)


def _scan(world: World, world_T_sensor: FloatArray, angles: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Exact ranges (S, B) and labels (S, B) of a 2D laser at poses (S, 4, 4)."""
    rays = scan_directions(angles) @ world_T_sensor[:, :3, :3].transpose(0, 2, 1)
    origins, normals = (np.ascontiguousarray(world_T_sensor[:, :3, k]) for k in (3, 2))
    return world.cast(origins, rays, normals)


def _streams(seed: int, count: int) -> list[np.random.Generator]:
    """Independent generators, so that no sensor's draws move when another's number changes."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
