"""Reader of ROS 1 and ROS 2 bags: LaserScan, PointCloud2, Odometry, and mounts from tf (needs rosbags)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import KEEPS_THE_REST, LogError
from slam.io.clouds.cloud import grid_of
from slam.io.raw import in_short
from slam.io.rosbags import _messages as ros
from slam.io.rosbags._opening import kept_open, opened
from slam.io.rosbags._salvaged import SalvagedBag
from slam.io.scan_files import in_order
from slam.lazy import Spool
from slam.sensors.log import Event, Log, OdometryReading, StoredCloud, StoredScan
from slam.sensors.rig import Rig
from spplanes._check import FloatArray
from spplanes.clouds.arrange import Grid, arrange
from spplanes.clouds.turn import told_turn


@dataclass(frozen=True)
class Topics:
    """Which topics of a bag are read, and which of its frames are the robot's."""

    scans: tuple[str, ...] = ()
    """Of LaserScan and PointCloud2; none: the clouds that come most often, or without clouds all laser scans."""
    odometry: str | None = None
    """Of Odometry; None: that which comes most often; without any, tf."""
    odometry_frame: str | None = None
    """Frame that tf tells the odometry from, in place of a topic; None: odom, or another frame of the world."""
    body_frame: str | None = None
    """Frame of the body; None: the child frame of the odometry, else base_link or the like."""

    def __post_init__(self) -> None:
        if self.odometry is not None and self.odometry_frame is not None:
            raise ValueError("--odometry-frame: expected one source of odometry, got --odometry-topic too")


@dataclass(eq=False)
class _Found:
    """What has been read so far."""

    spool: Spool
    """Ranges of 2D scans."""
    moves: ros.Moves
    """Frames and odometry."""
    angles: dict[str, FloatArray] = field(default_factory=dict)
    """Bearings of the last scan of each topic: the same scan after scan are kept once."""
    frames: dict[str, str] = field(default_factory=dict)
    """Of the first scan of each topic."""
    scans: list[tuple[int, str, FloatArray, tuple[int, int]]] = field(default_factory=list)
    """Time, topic, angles, and the ranges' place and number in the spool."""
    clouds: list[tuple[int, str, int]] = field(default_factory=list)
    """Time, topic, time of recording."""


def is_rosbag(path: Path) -> bool:
    """Whether a path is a bag by its name, or a folder with the metadata of one."""
    return (path.is_file() and path.suffix in (".bag", ".mcap", ".db3")) or (path / "metadata.yaml").is_file()


def read_rosbag(path: Path, topics: Topics | None = None, *, rig: Rig | None = None, keep_partial: bool = False) -> Log:
    """Read a bag: ROS 1 (.bag), ROS 2 (folder with metadata.yaml, .db3, .mcap).

    Times are those of the headers. Clouds stay in the bag until they are asked for. The body is the child frame of the
    odometry, else base_link or the like; mounts are the transforms from there to the frames of the sensors, as tf tells
    them, as far as they do not move.

    Args:
        path: the bag.
        topics: what to read; None: chosen as `Topics` says. A note says what was chosen and what else there is.
        rig: names of the sensors, which are read where no topics are told, and range images of clouds without order;
            sensors that it does not have are called as their topics, without slashes at the ends.
        keep_partial: of a bag that breaks off, use what comes before.
    """
    sensors = {} if rig is None else {_bare(one.record or name): (name, one) for name, one in rig.sensors.items()}
    wanted, notes = topics or Topics(), []
    with opened(path, keep_partial) as reader:
        notes += [bag.note for bag in reader.readers if isinstance(bag, SalvagedBag)]
        chosen = _choose(path, reader, replace(wanted, scans=wanted.scans or tuple(sensors)), notes)
        found = _read(path, reader, chosen, notes, keep_partial)
    if not found.scans and not found.clouds:
        raise LogError(path, "expected scans in the bag, found none before its end")
    body, odometry = ros.odometry_of(path, found.moves, chosen.body_frame, notes)
    told = {topic: sensors[_bare(topic)] for topic in chosen.scans if _bare(topic) in sensors}
    names = {topic: told[topic][0] if topic in told else _bare(topic) for topic in chosen.scans}
    events: list[Event] = list(starmap(OdometryReading, odometry))
    ranges = {"ranges": lambda row: found.spool.get(*found.scans[row][-1])}
    for row, (stamp, topic, angles, _) in enumerate(found.scans):
        events.append(StoredScan({"stamp_ns": stamp, "sensor": names[topic], "angles": angles}, ranges, row))
    for stamp, topic, received in found.clouds:
        read, grid = partial(_cloud_at, path, topic, keep_partial), grid_of(told[topic][1]) if topic in told else None
        readers = {"points": partial(_arranged, read, grid), "turn": partial(_turn_of, read)}
        events.append(StoredCloud({"stamp_ns": stamp, "sensor": names[topic]}, readers, received))
    return Log(_without_doubles(in_order(events), notes), path, notes, _mounts(found, body, names, notes, told))


def _bare(topic: str) -> str:
    return topic.strip("/")


def _choose(path: Path, reader: Any, wanted: Topics, notes: list[str]) -> Topics:
    """The topics that are read, and a note of them."""
    kinds = {topic: info.msgtype for topic, info in reader.topics.items()}
    counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    by_name = {_bare(topic): topic for topic in kinds}
    wanted = Topics(
        tuple(by_name.get(_bare(topic), topic) for topic in wanted.scans),
        wanted.odometry and by_name.get(_bare(wanted.odometry), wanted.odometry),
        *(frame and frame.lstrip("/") for frame in (wanted.odometry_frame, wanted.body_frame)),
    )
    usable = {kind: [t for t in sorted(kinds, key=lambda t: (-counts[t], t)) if kinds[t] == kind] for kind in _KINDS}
    asked = [(topic, (ros.SCAN, ros.CLOUD)) for topic in wanted.scans] + [(wanted.odometry, (ros.ODOMETRY,))]
    for topic, kinds_asked in asked:
        if topic is not None and topic not in kinds:
            there = ", ".join(t for kind in _KINDS for t in usable[kind]) or "none that can be used"
            raise LogError(path, f"expected the topic {topic}, which the bag does not have; it has {there}")
        if topic is not None and kinds[topic] not in kinds_asked:
            names = " or ".join(map(_short, kinds_asked))
            raise LogError(path, f"expected a topic of {names}, got {topic}, which is of {_short(kinds[topic])}")
    scans = wanted.scans or tuple(usable[ros.CLOUD][:1]) or tuple(usable[ros.SCAN])
    if not scans:
        raise LogError(path, "expected a topic of LaserScan or PointCloud2, found none")
    odometry = wanted.odometry or (None if wanted.odometry_frame else next(iter(usable[ros.ODOMETRY]), None))
    read = [f"{topic} ({counts[topic]} {_short(kinds[topic])})" for topic in (*scans, odometry) if topic]
    rest = [topic for kind in _KINDS for topic in usable[kind] if topic not in (*scans, odometry)]
    notes.append("read " + ", ".join(read) + (f"; also there: {', '.join(rest)}" if rest else ""))
    return replace(wanted, scans=scans, odometry=odometry)


_KINDS = (ros.CLOUD, ros.SCAN, ros.ODOMETRY)


def _short(msgtype: str | None) -> str:
    """The name of a type of messages without its package; of a topic that has several types that."""
    return "several types" if msgtype is None else msgtype.rsplit("/", 1)[-1]


def _read(path: Path, reader: Any, chosen: Topics, notes: list[str], keep_partial: bool) -> _Found:
    """All messages of the chosen topics and of tf."""
    found = _Found(Spool(path), ros.Moves(chosen.odometry_frame))
    wanted = {*chosen.scans, chosen.odometry}
    connections = [c for c in reader.connections if c.topic in wanted or c.msgtype in ros.TF]
    topic = "the bag"
    try:
        for connection, received, raw in reader.messages(connections):
            topic = connection.topic
            _take(found, topic, received, reader.deserialize(raw, connection.msgtype))
            topic = "the bag"
    except LogError:  # no room for its scans
        raise
    except Exception as error:  # as in opened
        if not keep_partial:
            raise LogError(path, f"{topic}: {in_short(error)}; {KEEPS_THE_REST}") from error
        notes.append(f"{topic} breaks off ({in_short(error)}); kept what came before")
    return found


def _take(found: _Found, topic: str, received: int, message: Any) -> None:
    kind = message.__msgtype__
    if kind in ros.TF:
        for one in message.transforms:
            parent, child = ros.frame_of(one), str(one.child_frame_id).lstrip("/")
            transform = ros.transform_of(one.transform.translation, one.transform.rotation)
            found.moves.add(ros.stamp_of(one, received), parent, child, transform)
        return
    stamp = ros.stamp_of(message, received)
    if kind == ros.ODOMETRY:
        pose = ros.transform_of(message.pose.pose.position, message.pose.pose.orientation)
        found.moves.odometry.append((stamp, str(message.child_frame_id).lstrip("/"), pose))
        return
    if kind == ros.SCAN:
        ranges, angles = ros.scan_of(message)
        kept = found.spool.put(ranges), ranges.size
        if not np.array_equal(found.angles.get(topic, ()), angles):
            found.angles[topic] = angles
        found.scans.append((stamp, topic, found.angles[topic], kept))
    else:
        ros.points_of(message)  # a wrong layout is said before any work is done
        found.clouds.append((stamp, topic, received))
    found.frames.setdefault(topic, ros.frame_of(message))


def _mounts(
    found: _Found, body: str | None, names: dict[str, str], notes: list[str], mounted: Collection[str]
) -> dict[str, FloatArray]:
    """body_T_sensor by name of the sensor, where tf tells it; of topics that are `mounted` the rig tells it anyway."""
    mounts = {}
    for topic, frame in sorted(found.frames.items()):
        mount = np.eye(4) if frame == body else None if body is None else found.moves.body_T(body, frame)
        if mount is not None:
            mounts[names[topic]] = mount
        elif topic not in mounted:
            notes.append(f"no transform from {body or 'a body'} to {frame or 'the sensor'}: {topic} taken at the body")
    return mounts


def _without_doubles(events: list[Event], notes: list[str]) -> list[Event]:
    """Without scans and readings that have the time of the one before."""
    kept: dict[tuple[str, int], Event] = {}
    for event in events:
        kept.setdefault(("" if isinstance(event, OdometryReading) else event.sensor, event.stamp_ns), event)
    if len(kept) < len(events):
        notes.append(f"left out {len(events) - len(kept)} messages with the time of the one before")
    return list(kept.values())


def _arranged(read: Callable[[int], FloatArray], grid: Grid | None, received: int) -> FloatArray:
    return arrange(read(received), grid)


def _turn_of(read: Callable[[int], FloatArray], received: int) -> tuple[float, float]:
    return told_turn(read(received))


def _cloud_at(path: Path, topic: str, keep_partial: bool, received: int) -> FloatArray:
    """One cloud of a bag, shape (S, B, 3) or (N, 3), m."""
    reader = kept_open(path, keep_partial)
    connections = [connection for connection in reader.connections if connection.topic == topic]
    try:
        for connection, _, raw in reader.messages(connections, start=received, stop=received + 1):
            return ros.points_of(reader.deserialize(raw, connection.msgtype))
    except Exception as error:  # as in opened
        raise LogError(path, f"{topic}: {in_short(error)}") from error
    raise LogError(path, f"expected a message of {topic} at {received} ns, found none")
