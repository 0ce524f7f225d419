"""A random drive: world x sensors x odometry x disturbance, put together and recorded with its truth."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from benchmarks.corpus.drives.disturbances import DISTURBANCES, Drive
from benchmarks.corpus.drives.scene import Scene
from benchmarks.corpus.drives.sensing import SENSORS, Sensing
from benchmarks.corpus.drives.wheels import ODOMETRIES, stated_noise
from benchmarks.corpus.drives.worlds import WORLDS
from slam.io.scan_files import in_order
from slam.sensors.log import CloudScan, Event, LaserScan, Log, OdometryReading
from slam.sensors.rig import Rig
from slam.simulation.record import BLOCK_BEAMS, SPEED_M_PER_S, START_NS, Truth
from slam.simulation.world import NO_PLANE

#: Odometry is read at least this often, m.
_READ_M = 0.05
_PARTS = {"world": WORLDS, "sensors": SENSORS, "odometry": ODOMETRIES, "disturbance": DISTURBANCES}


@dataclass(frozen=True)
class Recipe:
    """What a drive is made of: out of `WORLDS`, `SENSORS`, `ODOMETRIES` and `DISTURBANCES`."""

    world: str
    sensors: str
    odometry: str = "good"
    disturbance: str = "none"

    def __post_init__(self) -> None:
        for part, known in _PARTS.items():
            value = getattr(self, part)
            if value not in known:
                raise ValueError(f"{part}: expected one of {', '.join(known)}, got {value!r}")

    @classmethod
    def parse(cls, name: str) -> Self:
        """From world/sensors[/odometry[/disturbance]]."""
        words = name.split("/")
        if not 2 <= len(words) <= len(_PARTS):
            raise ValueError(f"name: expected world/sensors[/odometry[/disturbance]], got {name!r}")
        return cls(*words)

    @property
    def name(self) -> str:
        """world/sensors/odometry/disturbance."""
        return "/".join((self.world, self.sensors, self.odometry, self.disturbance))

    @classmethod
    def every(cls) -> list[Self]:
        """All combinations there are."""
        return [cls(*words) for words in itertools.product(*_PARTS.values())]


def make_drive(
    recipe: Recipe, seed: int, *, visit: int = 0, part: tuple[float, float] = (0.0, 1.0), backwards: bool = False
) -> Drive:
    """Draw building, noise and all else from the seed.

    Recipes with one world have the same building for the same seed, and the same wheels where the kind is the same:
    what differs between them is what differs in their names. Another `visit` of the same building has other noise of
    sensors and wheels. Of a level course only a `part` may be driven, from and to as shares of its length, or it may be
    driven `backwards`, from the end to the start.
    """
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)]
    build = WORLDS[recipe.world]
    scene = build(streams[0])
    if visit:
        streams[1:] = [np.random.default_rng(child) for child in np.random.SeedSequence([seed, visit]).spawn(4)]
    if part != (0.0, 1.0) or backwards:
        scene = replace(scene, course=scene.course.part(*part, backwards=backwards))
    drive = _recorded(scene, SENSORS[recipe.sensors], recipe, streams[1], streams[2])
    if recipe.disturbance == "prior_elsewhere":
        drive = replace(drive, elsewhere=build(streams[4]).world)
    return DISTURBANCES[recipe.disturbance](drive, streams[3])


def _recorded(
    scene: Scene, suite: Sequence[Sensing], recipe: Recipe, noise: np.random.Generator, wheels: np.random.Generator
) -> Drive:
    """Drive the whole course: odometry at every tick, every sensor at its own pace."""
    tick_m = min(_READ_M, *(sensing.every_m / 2.0 for sensing in suite))
    ticks = np.arange(int(scene.course.length_m / tick_m))
    stamps = START_NS + ticks * round(tick_m / SPEED_M_PER_S * 1e9)
    poses = scene.course.poses_at(ticks.astype(np.float64) * tick_m)
    stated = stated_noise(recipe.odometry, level=scene.course.level)
    rig = Rig(sensors={s.name: s.sensor for s in suite}, odometry=stated)
    read, labels = ODOMETRIES[recipe.odometry], {}
    events: list[Event] = []
    if read is not None:
        readings = read(poses, rig.odometry, wheels)
        events += [OdometryReading(int(t), pose) for t, pose in zip(stamps, readings, strict=True)]
    for sensing, rng in zip(suite, noise.spawn(len(suite)), strict=True):
        at = ticks[round(sensing.late_m / tick_m) :: round(sensing.every_m / tick_m)]
        scans, labels[sensing.name] = _scans(scene, sensing, at * tick_m, stamps[at], rng)
        events += scans
    truth = Truth(stamps, poses, scene.world.planes, labels)
    log = Log(in_order(events), Path(f"simulated {recipe.name}"))
    return Drive(recipe, scene.course.level, log, rig, truth, world=scene.world)


def _scans(
    scene: Scene, sensing: Sensing, way: np.ndarray, stamps: np.ndarray, rng: np.random.Generator
) -> tuple[list[LaserScan | CloudScan], np.ndarray]:
    """Scans after ways (S,) of the body, m, at times (S,), ns, and the plane each beam met, (S, B) or (S, F, B)."""
    fans, n_beams = sensing.beams.directions.shape[:2]
    block = max(1, BLOCK_BEAMS // (fans * n_beams))
    scans: list[LaserScan | CloudScan] = []
    labels = np.empty((len(way), fans * n_beams), dtype=np.int32)
    for first in range(0, len(way), block):
        some = slice(first, first + block)
        ranges, labels[some] = _cast(scene, sensing, way[some], stamps[some])
        read = sensing.read(ranges, rng)
        labels[some] = np.where(np.isnan(read), np.int32(NO_PLANE), labels[some])
        at_times = zip(stamps[some].tolist(), read, strict=True)
        scans += [sensing.beams.scan(stamp, sensing.name, row) for stamp, row in at_times]
    return scans, labels if sensing.beams.angles is not None else labels.reshape(-1, fans, n_beams)


def _cast(scene: Scene, sensing: Sensing, way: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact ranges and labels, both (S, F B), each fan cast as a scan of its own."""
    beams = sensing.beams
    fans, n_beams = beams.directions.shape[:2]
    late_s = sensing.turn_s * ((np.arange(fans) + 0.5) / fans - 0.5)  # a lidar turns from fan to fan
    poses = scene.course.poses_at((way[:, None] + SPEED_M_PER_S * late_s).ravel())
    world_T_sensor = (poses @ sensing.sensor.body_T_sensor).reshape(len(way), fans, 4, 4)
    turns = world_T_sensor[..., :3, :3]
    rays = np.einsum("sfij,fbj->sfbi", turns, beams.directions).reshape(-1, n_beams, 3)
    normals = np.einsum("sfij,fj->sfi", turns, beams.normals).reshape(-1, 3)
    times = (stamps[:, None] - START_NS) * 1e-9 + late_s
    ranges, labels = scene.cast(world_T_sensor[..., :3, 3].reshape(-1, 3), rays, normals, times.ravel())
    return ranges.reshape(-1, fans * n_beams), labels.reshape(-1, fans * n_beams)
