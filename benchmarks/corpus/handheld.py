"""Depth cameras carried by hand through a furnished room, without odometry: turning fast, or far between two images.

A room of one's own size with furniture about its middle, and a camera that wanders there as the sums of a few waves:
x, y, height, heading, pitch and roll. `sparse` rooms are larger with little in them, so that some images see a wall
and the floor and nothing else. Over a `desk` it goes to and fro along an arc and sees tables, screens, chairs and many
small things, round ones among them. The cameras of both read depths that are false by smooth waves over the image, no
farther than 4 m, and none where surfaces are grazed or jump, as real ones do. One that is `covered` sees nothing for
seconds, and goes on elsewhere.

References:
    Nguyen, Izadi, Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012,
    for the noise; Teichman, Miller, Thrun, "Unsupervised intrinsic calibration of depth sensors via SLAM", RSS 2013,
    for depths that are false by a pattern of the image.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from shapely import LineString, box
from shapely.affinity import rotate, translate

from benchmarks.corpus.drives.building import Roof, add_box, add_furniture, add_shell
from benchmarks.corpus.drives.disturbances import Drive
from benchmarks.corpus.drives.drive import Recipe
from benchmarks.corpus.drives.sensing import camera_beams, depth_sigma
from benchmarks.corpus.polygon_world import PolygonBuilder, PolygonWorld
from slam.io.clouds.depth import CAMERA_MOUNT, SENSOR
from slam.io.default_rigs import depth_rig
from slam.sensors.log import CloudScan, Log
from slam.simulation.record import START_NS, Truth
from slam.simulation.robots import Beams
from slam.simulation.world import NO_PLANE
from spplanes._check import FloatArray

#: Word that names of these drives begin with.
HANDHELD_WORD = "handheld"
#: Image: rows, columns, focal length in pixels (a Kinect's, every second pixel).
_ROWS, _COLUMNS, _FOCAL = 240, 320, 267.7
#: Depth of one step of the disparity, as a share of the squared depth, 1/m.
_STEP_PER_M = 3.6e-4
#: Depths of a real camera are false by the sum of six waves over the image, each of about this share.
_FALSE_SHARE = 0.006
#: Height of a desk, m.
_DESK_M = 0.75
#: Its depths end here, m; and are missing where they grow from pixel to pixel by more than this share, and length.
_FARTHEST_M, _GRAZING, _GRAZING_M = 4.0, 0.02, 0.004


@dataclass(frozen=True)
class _Carried:
    """How a camera is carried, and through what."""

    rate_hz: float
    images: int
    speed_m_per_s: float  # the highest along x or y
    turn_deg_per_s: float  # the highest
    room: Literal["furnished", "sparse", "desk"]
    covered_s: float = 0.0  # how long in the middle nothing is seen


#: Kinds: turning by up to 90 deg/s at 10 images a second; some 0.1 to 0.2 m and 7 deg between two images.
_KINDS = {
    "turning": _Carried(10.0, 120, 0.5, 90.0, "furnished"),
    "far": _Carried(3.0, 60, 0.5, 40.0, "furnished"),
    "sparse_turning": _Carried(10.0, 120, 0.5, 90.0, "sparse"),
    "sparse_far": _Carried(3.0, 60, 0.5, 40.0, "sparse"),
    "desk": _Carried(10.0, 120, 0.5, 40.0, "desk"),
    "covered": _Carried(10.0, 120, 0.5, 90.0, "furnished", covered_s=3.0),
}
#: Names of these drives.
HANDHELD = [f"{HANDHELD_WORD}/{kind}" for kind in _KINDS]


def make_handheld(name: str, seed: int) -> Drive:
    """Draw the room, the way and the noise of one out of `HANDHELD` from the seed."""
    if name not in HANDHELD:
        raise ValueError(f"name: expected one of {', '.join(HANDHELD)}, got {name!r}")
    carried = _KINDS[name.removeprefix(f"{HANDHELD_WORD}/")]
    rooms, ways, noise = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
    world = _desk(rooms) if carried.room == "desk" else _room(carried, rooms)
    poses = _poses(carried, ways)
    times_s = np.arange(carried.images) / carried.rate_hz
    seeing = np.abs(times_s - 0.5 * times_s[-1]) >= 0.5 * carried.covered_s
    stamps, poses = START_NS + np.round(1e9 * times_s[seeing]).astype(np.int64), poses[seeing]
    camera, scans, labels = _Camera.drawn(carried, noise), [], []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        points, label = camera.image(world, pose @ CAMERA_MOUNT, noise)
        scans.append(CloudScan(stamp, SENSOR, points))
        labels.append(label)
    truth = Truth(stamps, poses, world.planes, {SENSOR: np.array(labels)})
    recipe = Recipe("hall" if carried.room == "sparse" else "cluttered", "depth", "absent")  # the nearest of them
    return Drive(recipe, level=False, log=Log(scans, Path(f"simulated {name}")), rig=depth_rig(), truth=truth)


def _room(carried: _Carried, rng: np.random.Generator) -> PolygonWorld:
    """A room with furniture all round its middle."""
    half_x, half_y = rng.uniform(3.0, 4.0, 2) if carried.room == "sparse" else rng.uniform(2.2, 3.2, 2)
    plan, builder = box(-half_x, -half_y, half_x, half_y), PolygonBuilder()
    add_shell(builder, plan, Roof.flat(rng.uniform(2.4, 3.0)))
    middle, pieces = LineString([(-0.8, 0.0), (0.8, 0.0)]), 6 if carried.room == "sparse" else 14
    add_furniture(builder, plan, middle, rng, pieces=pieces, oblique=True, poles=2)
    return builder.build()


def _desk(rng: np.random.Generator) -> PolygonWorld:
    """A room with two desks in its middle, what stands on them, chairs about them, and a plant in a corner."""
    half_x, half_y = rng.uniform(2.3, 3.2, 2)
    builder = PolygonBuilder()
    add_shell(builder, box(-half_x, -half_y, half_x, half_y), Roof.flat(rng.uniform(2.5, 3.0)))

    def slab(spot: ArrayLike, turn: float, width: float, depth: float, foot: float, height: float) -> None:
        outline = translate(
            rotate(box(-width / 2, -depth / 2, width / 2, depth / 2), turn, use_radians=True), *np.asarray(spot)
        )
        add_box(builder, outline, foot + height, foot + height, foot=foot)

    for turn, middle in ((rng.uniform(-0.2, 0.2), 0.0), (rng.uniform(3.1, 3.2), 0.85)):
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

        def spot(along: float, across: float, axes: FloatArray = axes, y: float = middle) -> FloatArray:
            return np.array([along, across]) @ axes + (0.0, y)

        slab((0.0, middle), turn, 1.6, 0.8, 0.71, _DESK_M - 0.71)
        for leg in (-0.75, 0.75):
            slab(spot(leg, 0.0), turn, 0.05, 0.7, 0.0, 0.7)
        for along in rng.uniform(-0.55, 0.55, rng.integers(1, 3)):  # screens
            foot = spot(along, 0.22)
            builder.add_bar((*foot, _DESK_M), (*foot, 0.9), 0.04)
            slab(foot, turn + rng.normal(0.0, 0.3), rng.uniform(0.4, 0.55), 0.04, 0.88, 0.34)
        for along in rng.uniform(-0.7, 0.7, rng.integers(6, 12)):  # cups, rolls, boxes
            foot, size = spot(along, rng.uniform(-0.35, 0.3)), rng.uniform(0.03, 0.12, 3)
            if rng.random() < 0.5:
                builder.add_bar((*foot, _DESK_M), (*foot, _DESK_M + 2.0 * size[2]), size[0])
            else:
                slab(foot, rng.uniform(0.0, 3.0), 2.0 * size[0], 2.0 * size[1], _DESK_M, 2.0 * size[2])
    for x, y, turn in zip(rng.uniform(-1.8, 1.8, 4), (-0.8, -1.8, 1.8, 1.9), rng.uniform(0.0, 6.3, 4), strict=True):
        builder.add_bar((x, y, 0.1), (x, y, 0.45), 0.03)
        slab((x, y), turn, 0.45, 0.45, 0.45, 0.06)
        slab((x - 0.22 * np.cos(turn), y - 0.22 * np.sin(turn)), turn, 0.05, 0.42, 0.55, 0.5)
    for leaf in rng.normal((half_x - 0.5, half_y - 0.5, 1.1), (0.15, 0.15, 0.3), (25, 3)):
        builder.add_bar(leaf, leaf + rng.normal(0.0, 0.06, 3), rng.uniform(0.02, 0.05))
    return builder.build()


def _poses(carried: _Carried, rng: np.random.Generator) -> FloatArray:
    """world_T_body at every image, shape (N, 4, 4)."""
    times_s, turn = np.arange(carried.images) / carried.rate_hz, np.deg2rad(carried.turn_deg_per_s)

    def wave(peak_rate: float, period_s: float, most: float = np.inf) -> FloatArray:
        """The sum of three waves of about that period, its rate at most so high, itself at most so far from nought."""
        frequencies = 2.0 * np.pi / (period_s * rng.uniform(0.6, 1.8, 3))
        heights, phases = rng.uniform(0.5, 1.0, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        angles = np.outer(np.linspace(0.0, times_s[-1], 4000), frequencies) + phases
        highest = np.abs((heights * np.cos(angles)).sum(axis=1)).max()
        values = (heights / frequencies * np.sin(np.outer(times_s, frequencies) + phases)).sum(axis=1)
        values = (values - values.mean()) * peak_rate / highest
        return values * min(1.0, most / np.abs(values).max())

    x, y = wave(carried.speed_m_per_s, 6.0, 1.0), wave(carried.speed_m_per_s, 6.0, 0.7)
    yaw, pitch, roll = wave(turn, 7.0), np.deg2rad(15.0) + wave(turn / 4.0, 5.0, 0.45), wave(np.deg2rad(10.0), 3.0)
    if carried.room == "desk":  # along an arc about the desk, looking down on it
        around, away = 0.9 * x - np.pi / 2.0, 1.25 + 0.4 * y
        x, y = away * np.cos(around), away * np.sin(around)
        yaw, pitch = np.arctan2(-y, -x) + yaw, pitch + np.deg2rad(12.0)
    poses = np.tile(np.eye(4), (carried.images, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    poses[:, :3, 3] = np.column_stack([x, y, 1.4 + wave(0.15, 4.0)])
    return poses


@dataclass(frozen=True, eq=False)
class _Camera:
    """A camera, a fan of beams for every row of pixels, with the errors of its depths."""

    beams: Beams
    false: FloatArray  # by what share depths are false, shape (H, W)
    drops: bool  # whether depths are missing as those of real cameras are

    @classmethod
    def drawn(cls, carried: _Carried, rng: np.random.Generator) -> Self:
        """One camera out of many."""
        beams = camera_beams(_ROWS, _COLUMNS, _FOCAL)
        x, y = np.moveaxis(beams.directions[..., :2] / beams.directions[..., 2:], -1, 0)
        slopes, sizes, starts = rng.uniform(-1.5, 1.5, (6, 2)), rng.normal(0.0, _FALSE_SHARE, 6), rng.uniform(0, 7, 6)
        waves = np.column_stack((slopes, sizes, starts))
        false = np.sum([c * np.cos(2.0 * np.pi * (a * x + b * y) + start) for a, b, c, start in waves], axis=0)
        real = carried.room != "furnished"
        return cls(beams, false if real else np.zeros_like(x), real)

    def image(
        self, world: PolygonWorld, world_T_camera: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, np.ndarray]:
        """Points (H, W, 3) in the camera's frame, NaN for no depth, and the plane of each, (H, W)."""
        turn, directions = world_T_camera[:3, :3], self.beams.directions
        origins = np.tile(world_T_camera[:3, 3], (_ROWS, 1))
        ranges, labels = world.cast(origins, directions @ turn.T, self.beams.normals @ turn.T)
        ahead = directions[..., 2]
        depth = np.where(np.isfinite(ranges), ranges * ahead, 1e3)
        depth = (depth + depth_sigma(depth) * _smoothed(rng.standard_normal(depth.shape))) * (1.0 + self.false)
        step = _STEP_PER_M * depth**2
        depth = np.round(depth / step) * step
        seen = (depth > 0.5) & (depth < (_FARTHEST_M if self.drops else 5.0))
        if self.drops:
            down, right = np.gradient(depth)
            seen &= np.hypot(down, right) < _GRAZING * depth + _GRAZING_M
        points = np.where(seen, depth / ahead, np.nan)[..., None] * directions
        return points, np.where(seen, labels, NO_PLANE).astype(np.int32)


def _smoothed(noise: FloatArray) -> FloatArray:
    """Noise that neighbours share, as disparities are of windows; its variance stays."""
    return (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + np.roll(noise, (1, 1), (0, 1))) / 2.0
