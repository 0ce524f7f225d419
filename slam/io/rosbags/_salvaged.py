"""A ROS 1 bag or an MCAP file that was cut off, or whose index is wrong: its records one after another, without it.

Both formats are rows of records, some of them chunks of further ones, with an index at the end that a recording which
broke off does not have. `SalvagedBag` reads the records up to the break, all into memory, and is a reader of one file
as rosbags' `AnyReader` has them.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from slam.errors import LogError
from slam.io.raw import TooLarge, unpack
from slam.io.rosbags._messages import definition_of

_ROS1_MAGIC, _MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
_MESSAGE, _BAG, _CHUNK, _CONNECTION = 0x02, 0x03, 0x05, 0x07
_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK = 0x03, 0x04, 0x05, 0x06


class _Cut(Exception):
    """The records end here."""


class SalvagedBag:
    """The whole messages before the break."""

    def __init__(self, path: Path) -> None:
        self._messages: list[tuple[Any, int, bytes]] = []
        self._connections: dict[int, Any] = {}
        self._schemas: dict[int, tuple[str, str]] = {}
        #: Whether the records go on to the end of the file.
        self.is_whole = True
        self._chunks, self._stated_chunks, self._strangers = 0, 0, 0
        data = path.read_bytes()
        #: Whether it is a ROS 1 bag.
        self.is_ros1 = data.startswith(_ROS1_MAGIC)
        if not data.startswith((_ROS1_MAGIC, _MCAP_MAGIC)):
            raise LogError(path, "expected a ROS 1 bag or an MCAP file to salvage, got another")
        read, magic = (self._ros1, _ROS1_MAGIC) if self.is_ros1 else (self._mcap, _MCAP_MAGIC)
        try:
            for number, stamp, raw in read(path, data, len(magic)):
                if number in self._connections:
                    self._messages.append((self._connections[number], stamp, raw))
                else:
                    self._strangers += 1
        except (_Cut, struct.error):  # the latter of numbers that are cut off
            self.is_whole = False
        self._messages.sort(key=lambda one: one[1])

    def __enter__(self) -> SalvagedBag:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    @property
    def note(self) -> str:
        """What became of the bag, for the notes of a log."""
        if not self.is_whole:
            return "the bag breaks off and has no index; kept the messages that are whole"
        missing = []
        if self._chunks < self._stated_chunks:
            missing.append(f"{self._stated_chunks - self._chunks} of {self._stated_chunks} chunks")
        if self._strangers:
            missing.append(f"the topics of {self._strangers} messages")
        told = " and ".join(missing) or "nothing"
        return f"the bag's index contradicts its records; read to the end without it: {told} is missing"

    @property
    def connections(self) -> list[Any]:
        """Topics that were announced before the break."""
        return list(self._connections.values())

    @property
    def topics(self) -> dict[str, Any]:
        """Topics with the number of whole messages."""
        from rosbags.interfaces import TopicInfo

        counts = Counter(connection.topic for connection, _, _ in self._messages)
        return {one.topic: TopicInfo(one.msgtype, one.msgdef, counts[one.topic], [one]) for one in self.connections}

    def messages(
        self, connections: Collection[Any] = (), start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Any, int, bytes]]:
        """Messages of some connections, in the order of their times, ns."""
        wanted = {one.topic for one in connections}
        for connection, stamp, raw in self._messages:
            inside = (start is None or stamp >= start) and (stop is None or stamp < stop)
            if inside and connection.topic in wanted:
                yield connection, stamp, raw

    def _connect(self, number: int, topic: str, msgtype: str, definition: str) -> None:
        from rosbags.interfaces import Connection, ConnectionExtRosbag1

        told = definition_of(msgtype, definition), "", 0, ConnectionExtRosbag1(None, None)
        self._connections[number] = Connection(number, topic, msgtype, *told, self)

    def _ros1(self, path: Path, data: bytes, place: int) -> Iterator[tuple[int, int, bytes]]:
        """Record by record: header with fields name=value, then data."""
        while place < len(data):
            header, place = _sized(data, place)
            fields = _fields(header)
            self._chunks += fields.get(b"op") == bytes([_CHUNK])
            if fields.get(b"op") == bytes([_CHUNK]) and fields.get(b"compression") == b"none":
                place += 4  # its records are records like others: those before the break are whole
                continue
            body, place = _sized(data, place)
            kind = fields.get(b"op", b"\0")[0]
            if kind == _BAG and b"chunk_count" in fields:
                (self._stated_chunks,) = struct.unpack("<I", fields[b"chunk_count"])
            elif kind == _CHUNK:
                yield from self._ros1(path, _unpack(path, body, fields[b"compression"].decode()), 0)
            elif kind == _CONNECTION:
                told = _fields(body)
                msgtype = told[b"type"].decode().replace("/msg/", "/").replace("/", "/msg/")
                (number,) = struct.unpack("<I", fields[b"conn"])
                definition = told[b"message_definition"].decode(errors="replace")
                self._connect(number, fields[b"topic"].decode(), msgtype, definition)
            elif kind == _MESSAGE:
                seconds, rest = struct.unpack("<II", fields[b"time"])
                yield struct.unpack("<I", fields[b"conn"])[0], seconds * 1_000_000_000 + rest, body

    def _mcap(self, path: Path, data: bytes, place: int) -> Iterator[tuple[int, int, bytes]]:
        """Record by record: a byte for its kind, its length, its content."""
        while place < len(data):
            kind, size = struct.unpack_from("<BQ", data, place)
            compression = b""
            if kind == _MCAP_CHUNK:
                compression, at = _sized(data, place + 37)
                if not compression:
                    place = at + 8  # as above
                    continue
            body, place = data[place + 9 : place + 9 + size], place + 9 + size
            if len(body) < size:
                raise _Cut
            if kind == _MCAP_CHUNK:
                packed = body[36 + len(compression) + 4 :]
                yield from self._mcap(path, _unpack(path, packed, compression.decode()), 0)
            elif kind == _MCAP_SCHEMA:
                (number,) = struct.unpack_from("<H", body)
                name, at = _sized(body, 2)
                _, at = _sized(body, at)
                self._schemas[number] = (name.decode(), _sized(body, at)[0].decode(errors="replace"))
            elif kind == _MCAP_CHANNEL:
                number, schema = struct.unpack_from("<HH", body)
                if schema in self._schemas:
                    self._connect(number, _sized(body, 4)[0].decode(), *self._schemas[schema])
            elif kind == _MCAP_MESSAGE:
                number, _, stamp, _ = struct.unpack_from("<HIQQ", body)
                yield number, stamp, body[22:]


def _sized(data: bytes, place: int) -> tuple[bytes, int]:
    """Bytes with their length in front of them, and where they end."""
    (size,) = struct.unpack_from("<I", data, place)
    end = place + 4 + size
    if end > len(data):
        raise _Cut
    return data[place + 4 : end], end


def _fields(header: bytes) -> dict[bytes, bytes]:
    """The fields name=value of a header."""
    fields, place = {}, 0
    while place < len(header):
        field, place = _sized(header, place)
        name, _, value = field.partition(b"=")
        fields[name] = value
    return fields


def _unpack(path: Path, data: bytes, compression: str) -> bytes:
    """The records of a chunk; a chunk that is damaged is where the bag ends."""
    try:
        return unpack(data, compression)
    except TooLarge as error:
        raise LogError(path, str(error)) from error
    except Exception as error:
        raise _Cut from error
