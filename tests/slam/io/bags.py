"""ROS 1 and ROS 2 bags of any messages, written by rosbags."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rosbags", reason="rosbags is not installed")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from spplanes._check import FloatArray

TF = "tf2_msgs/msg/TFMessage"
SECOND = 1_000_000_000


class Messages:
    """Makes messages of one typestore."""

    def __init__(self, ros1: bool) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        self.types, self.ros1 = self.store.types, ros1

    def make(self, kind: str, **values: Any) -> Any:
        return self.types[kind.replace("/", "/msg/")](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        seconds, rest = divmod(stamp_ns, SECOND)
        stamp = self.make("builtin_interfaces/Time", sec=seconds, nanosec=rest)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def _turn(self, transform: FloatArray) -> Any:
        x, y, z, w = Rotation.from_matrix(transform[:3, :3]).as_quat().tolist()
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def _xyz(self, kind: str, transform: FloatArray) -> Any:
        x, y, z = transform[:3, 3].tolist()
        return self.make(f"geometry_msgs/{kind}", x=x, y=y, z=z)

    def odometry(self, stamp_ns: int, odom_T_body: FloatArray, child: str = "base_link") -> Any:
        position, zero = self._xyz("Point", odom_T_body), self._xyz("Vector3", np.eye(4))
        pose = self.make("geometry_msgs/Pose", position=position, orientation=self._turn(odom_T_body))
        twist = self.make("geometry_msgs/Twist", linear=zero, angular=zero)
        pose = self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
        twist = self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
        header = self.header(stamp_ns, "odom")
        return self.make("nav_msgs/Odometry", header=header, child_frame_id=child, pose=pose, twist=twist)

    def tf(self, parent: str, child: str, transform: FloatArray, stamp_ns: int = 0) -> Any:
        shift, header = self._xyz("Vector3", transform), self.header(stamp_ns, parent)
        inside = self.make("geometry_msgs/Transform", translation=shift, rotation=self._turn(transform))
        one = self.make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=inside)
        return self.types[TF](transforms=[one])

    def scan(self, stamp_ns: int, ranges: FloatArray, frame: str = "laser", **other: float) -> Any:
        angles = {"angle_min": -1.5, "angle_max": 1.5, "angle_increment": 3.0 / (len(ranges) - 1)}
        limits = {"time_increment": 1e-4, "scan_time": 0.1, "range_min": 0.1, "range_max": 20.0}
        seen = {"ranges": ranges.astype(np.float32), "intensities": np.empty(0, np.float32)}
        header = self.header(stamp_ns, frame)
        return self.make("sensor_msgs/LaserScan", header=header, **{**angles, **limits, **seen, **other})

    def cloud(
        self, stamp_ns: int, points: FloatArray, frame: str = "lidar", *, layout: str = "plain", **other: Any
    ) -> Any:
        """`layout`: plain, shuffled (fields in another order, room between), padded (rows), big (endian), double."""
        grid = points if points.ndim == 3 else points[None]
        float_ = {"big": ">f4", "double": "<f8"}.get(layout, "<f4")
        x, y, z = fields = [(axis, float_) for axis in "xyz"]
        if layout == "shuffled":
            fields = [("room", "V4"), z, ("ring", "<u2"), ("more", "V10"), x, ("still more", "V4"), y]
        dtype = np.dtype(fields if layout == "plain" else [*fields, ("end", "V4")])
        table = np.zeros(grid.shape[:2], dtype=dtype)
        for k, axis in enumerate("xyz"):
            table[axis] = grid[..., k]
        padding = 24 if layout == "padded" else 0
        data = np.frombuffer(b"".join(row.tobytes() + bytes(padding) for row in table), dtype=np.uint8)
        types = {np.dtype(kind): number for kind, number in (("<u2", 4), ("<f4", 7), (">f4", 7), ("<f8", 8))}
        told = [
            self.make("sensor_msgs/PointField", name=name, offset=place, datatype=types[kind], count=1)
            for name, (kind, place, *_) in dtype.fields.items()
            if kind in types
        ]
        rows, columns = table.shape
        step = dtype.itemsize
        sizes = {"height": rows, "width": columns, "point_step": step, "row_step": step * columns + padding}
        values = {"fields": told, "is_bigendian": layout == "big", "data": data, "is_dense": False}
        return self.make("sensor_msgs/PointCloud2", header=self.header(stamp_ns, frame), **{**sizes, **values, **other})


def write(folder: Path, kind: str, make: Any) -> Path:
    """A bag of `make(messages)`: tuples of topic, time of recording and message."""
    ros1 = kind.startswith("ros1")
    messages = Messages(ros1)
    path = folder / ("run 1 ü.bag" if ros1 else "run 1 ü")
    plugin = StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3
    writer: Any = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}
    if kind in ("ros1 bz2", "ros1 lz4"):
        writer.set_compression(Writer1.CompressionFormat[kind[-3:].upper()])
        writer.chunk_threshold = 1000  # so that there are several
    if "zstd" in kind:
        part = {"files": CompressionMode.FILE, "messages": CompressionMode.MESSAGE}
        writer.set_compression(part.get(kind.split()[-1], CompressionMode.STORAGE), CompressionFormat.ZSTD)
    with writer:
        for topic, stamp_ns, message in make(messages):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=messages.store)
            pack = messages.store.serialize_ros1 if ros1 else messages.store.serialize_cdr
            writer.write(connections[topic], stamp_ns, pack(message, name))
    if kind.endswith("alone"):
        (inside,) = [entry for entry in path.iterdir() if entry.suffix in (".db3", ".mcap")]
        return Path(shutil.move(inside, folder / f"alone{inside.suffix}"))
    return path
