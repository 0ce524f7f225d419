"""What the messages of a bag say: clouds of any layout, laser scans, transforms; the odometry and the body in them."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse, poses_of
from spplanes._check import FloatArray

#: The messages that are read.
SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
ODOMETRY, TF = "nav_msgs/msg/Odometry", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
READ = (SCAN, CLOUD, ODOMETRY, *TF)
#: PointField's numbers of types.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def definition_of(msgtype: str, text: str) -> Any:
    """The definition of a type of messages as rosbags keeps it; empty for a type that is not read.

    Bags of 2010 call the header roslib/Header; it is the same, and rosbags knows the later name alone. What else is in
    a bag may be defined as badly as it likes.
    """
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

    if msgtype not in READ:
        return MessageDefinition(MessageDefinitionFormat.NONE, "")
    return MessageDefinition(MessageDefinitionFormat.MSG, re.sub(r"\broslib/Header\b", "std_msgs/Header", text))


def stamp_of(message: Any, received_ns: int) -> int:
    """Time in the header of a message, ns; where nobody filled it in, the time it was recorded."""
    stamp = message.header.stamp
    told = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return told or received_ns


def frame_of(message: Any) -> str:
    """The frame in the header of a message, without the slash that old ones begin with."""
    return str(message.header.frame_id).lstrip("/")


def points_of(message: Any) -> FloatArray:
    """Points of a PointCloud2, shape (N, 3), or (S, B, 3) of an organised one, m; NaN = no return.

    Fields may be in any order, of any type, with room between and after them, rows may be padded, and the bytes of
    either order. Points at the origin are no returns. A ValueError says what does not fit.
    """
    height, width = int(message.height), int(message.width)
    step, row_step, data = int(message.point_step), int(message.row_step), np.asarray(message.data)
    fields = {str(field.name): field for field in message.fields}
    order = ">" if message.is_bigendian else "<"
    axes = [fields[axis] for axis in "xyz" if axis in fields and int(fields[axis].datatype) in _TYPES]
    if len(axes) < 3:
        raise ValueError(f"expected the fields x, y and z, got {', '.join(fields)[:60] or 'none'}")
    formats = [order + _TYPES[int(axis.datatype)] for axis in axes]
    offsets = [int(axis.offset) for axis in axes]
    if max(offset + np.dtype(kind).itemsize for offset, kind in zip(offsets, formats, strict=True)) > step:
        raise ValueError(f"expected fields within the {step} bytes of a point, got offsets {offsets}")
    row_step = row_step if height > 1 else max(row_step, step * width)
    if row_step < step * width or height * row_step - (row_step - step * width) > data.nbytes:
        raise ValueError(f"expected {height} rows of {width} points of {step} bytes, got {data.nbytes} bytes")
    dtype = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step})
    table = np.ndarray((height, width), dtype, buffer=data.tobytes(), strides=(row_step, step))
    points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    points[~np.isfinite(points).all(axis=-1) | (points == 0.0).all(axis=-1)] = np.nan
    return points if height > 1 else points[0]


def scan_of(message: Any) -> tuple[FloatArray, FloatArray]:
    """Ranges (B,), m, NaN = no return, and ascending bearings (B,), rad, of a LaserScan, whichever way it turns."""
    ranges = np.asarray(message.ranges, dtype=np.float64)
    first, step = float(message.angle_min), float(message.angle_increment)
    if not ranges.size or not (np.isfinite(first) and np.isfinite(step) and step != 0.0):
        raise ValueError(f"expected beams at finite angles, got {ranges.size} from {first:g} by {step:g} rad")
    least, most = float(message.range_min), float(message.range_max)
    most = most if np.isfinite(most) and most > 0.0 else np.inf
    with np.errstate(invalid="ignore"):
        inside = (ranges >= max(least, 1e-6)) & (ranges < most) & np.isfinite(ranges)
    ranges = np.where(inside, ranges, np.nan)
    angles = first + step * np.arange(ranges.size, dtype=np.float64)
    return (ranges, angles) if step > 0.0 else (ranges[::-1].copy(), angles[::-1].copy())


def transform_of(translation: Any, rotation: Any) -> FloatArray:
    """A translation and a quaternion as a (4, 4) transform; a ValueError where they are none."""
    place = translation.x, translation.y, translation.z
    return poses_of(np.array([[*place, rotation.x, rotation.y, rotation.z, rotation.w]], dtype=np.float64))[0]


#: Names that bodies have, the first that is there is taken.
BODIES = ("base_link", "base_footprint", "base", "base_frame", "imu_link", "imu")
#: Frames of the world, which no body has.
WORLDS = ("map", "odom", "world", "earth")


def is_world(frame: str) -> bool:
    """Whether a frame is one of the world: by its name, or by one that begins with odom, such as odom_combined."""
    name = frame.rsplit("/", 1)[-1]
    return name in WORLDS or name.startswith("odom")


@dataclass(eq=False)
class Moves:
    """What a bag tells of frames and how they move; those that move are known apart from those that do not."""

    root: str | None = None
    """A frame of the world by somebody's word."""
    by_tf: list[tuple[int, str, str, FloatArray]] = field(default_factory=list)
    """Transforms out of frames of the world: time, parent, child, parent_T_child."""
    odometry: list[tuple[int, str, FloatArray]] = field(default_factory=list)
    """Of Odometry: time, frame of the body, odom_T_child."""
    _parents: dict[str, tuple[str, FloatArray]] = field(default_factory=dict)
    """Of frames below none of the world's: parent and parent_T_child."""
    _moving: set[str] = field(default_factory=set)

    def add(self, stamp_ns: int, parent: str, child: str, transform: FloatArray) -> None:
        """A transform of tf."""
        if parent == self.root or is_world(parent):
            self.by_tf.append((stamp_ns, parent, child, transform))
            return
        known = self._parents.setdefault(child, (parent, transform))
        if known[0] != parent or np.abs(known[1] - transform).max() > 1e-6:  # m and rad
            self._moving.add(child)

    @property
    def frames(self) -> set[str]:
        """All that are below none of the world's, and those above them."""
        return {*self._parents, *(parent for parent, _ in self._parents.values())}

    @property
    def moving_roots(self) -> dict[str, str]:
        """Frames that have none above them, with the first of those that move against them."""
        moving = {self._parents[child][0]: child for child in sorted(self._moving, reverse=True)}
        return {parent: child for parent, child in sorted(moving.items()) if parent not in self._parents}

    def body_T(self, body: str, sensor: str) -> FloatArray | None:
        """body_T_sensor (4, 4) by transforms that do not move; None: they do not connect the two."""
        up_from_body, up_from_sensor = self._chain(body), self._chain(sensor)
        common = next((frame for frame in up_from_sensor if frame in up_from_body), None)
        return None if common is None else inverse(up_from_body[common]) @ up_from_sensor[common]

    def _chain(self, frame: str) -> dict[str, FloatArray]:
        """ancestor_T_frame of the frame itself and of all above it that do not move against it."""
        chain, transform = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents and frame not in self._moving:
            frame, step = self._parents[frame]
            if frame in chain or is_world(frame):
                break
            transform = step @ transform
            chain[frame] = transform
        return chain


def odometry_of(
    path: Path, found: Moves, body: str | None, notes: list[str]
) -> tuple[str | None, list[tuple[int, FloatArray]]]:
    """Frame of the body, and its poses: of Odometry, else of tf from odom (or another frame of the world).

    `body`: its frame by somebody's word; None: the child frame of the odometry, else one of the usual names. A LogError
    says that a frame that was named is not there, or moves against the one whose odometry is told.
    """
    child, poses = _told_odometry(path, found, notes)
    if body is None or body == child:
        return child or next((frame for frame in BODIES if frame in found.frames), None), poses
    if child is None:
        if poses or body in found.frames:
            return body, poses
        there = ", ".join(sorted(found.frames)) or "none"
        raise LogError(path, f"--body-frame: expected a frame of tf, got {body}; there are {there}")
    child_T_body = found.body_T(child, body)
    if child_T_body is None:
        problem = f"expected tf from {child}, the frame of the odometry, to {body}, found none"
        raise LogError(path, f"--body-frame: {problem}")
    return body, [(stamp, pose @ child_T_body) for stamp, pose in poses]


def _told_odometry(path: Path, found: Moves, notes: list[str]) -> tuple[str | None, list[tuple[int, FloatArray]]]:
    """The frame whose poses odometry tells, and those."""
    if found.odometry:
        child = next((child for _, child, _ in found.odometry if child), None)
        return child, [(stamp, pose) for stamp, _, pose in found.odometry]
    parents = dict.fromkeys(["odom", *WORLDS, *sorted({parent for _, parent, _, _ in found.by_tf})])
    for world in parents if found.root is None else [found.root]:
        of_world = [row for row in found.by_tf if row[1] == world and not is_world(row[2])]
        children = Counter(child for _, _, child, _ in of_world)
        if children:
            body = children.most_common(1)[0][0]
            notes.append(f"no Odometry: took tf from {world} to {body}")
            return body, [(stamp, pose) for stamp, _, child, pose in of_world if child == body]
    moving = found.moving_roots
    if found.root is not None:
        there = ", ".join(sorted({*moving, *(parent for _, parent, _, _ in found.by_tf)})) or "none that moves"
        raise LogError(path, f"--odometry-frame: expected tf from {found.root} to a body, found none; it has {there}")
    for root, child in moving.items():
        notes.append(f"tf moves from {root} to {child}; if that is odometry: --odometry-frame {root}")
    return None, []
