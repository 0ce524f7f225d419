"""ROS messages as arrays: PointCloud2 of any layout, LaserScan, transforms."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from slam.geometry.frames import poses_of
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
    either order. Points at the origin are no returns.

    Raises:
        ValueError: no x, y, z, fields outside of a point, or fewer bytes than points.
    """
    height, width = int(message.height), int(message.width)
    step, row_step, data = int(message.point_step), int(message.row_step), np.asarray(message.data)
    fields = {str(field.name): field for field in message.fields}
    order = ">" if message.is_bigendian else "<"
    formats: list[str] = []
    offsets: list[int] = []
    for axis in "xyz":
        kind = _TYPES.get(int(fields[axis].datatype)) if axis in fields else None
        if kind is None:
            raise ValueError(f"expected the fields x, y and z, got {', '.join(fields)[:60] or 'none'}")
        formats.append(order + kind)
        offsets.append(int(fields[axis].offset))
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
    """Ranges (B,), m, NaN = no return, and ascending bearings (B,), rad, of a LaserScan, whichever way it turns.

    Raises:
        ValueError: no beams, or an angle that is none.
    """
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
    """A translation and a quaternion as a (4, 4) transform.

    Raises:
        ValueError: numbers that are not finite, or a quaternion that is none.
    """
    place = translation.x, translation.y, translation.z
    return poses_of(np.array([[*place, rotation.x, rotation.y, rotation.z, rotation.w]], dtype=np.float64))[0]
