"""Measurements and decisions as bytes and back, bit for bit: JSON for the structure, raw arrays behind it.

Only the classes listed here can come out of a file; nothing in a file is ever run.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from factors.association.observations import LineObservation, PlaneObservation
from slam._field_types import check_fields, holds
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.frontend.pose_measurements import KINDS, PlaceMatch
from slam.lazy import Stored
from slam.map.data_association import Candidate, Decision
from slam.map.map_planes import MapPlane
from slam.sensors.log import CloudScan, LaserScan
from spplanes import Plane, ScanLine

_CLASSES: dict[str, type] = {
    one.__name__: one
    for one in (
        Candidate,
        CloudScan,
        Decision,
        Keyframe,
        LaserScan,
        LineObservation,
        MapPlane,
        Motion,
        PlaceMatch,
        Plane,
        PlaneObservation,
        ScanLine,
        *KINDS,
    )
}
#: Numbers an array may have, by their name in a record: floats, integers, booleans.
_NUMBER_TYPES = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?", np.longdouble)
_NUMBERS = {kind.str: kind for kind in (np.dtype(one).newbyteorder("<") for one in _NUMBER_TYPES)}
_LENGTH = struct.Struct("<I")
#: What bytes that are none of ours may raise on their way into values.
_WRONG_BYTES = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, struct.error),
    *(RecursionError, MemoryError, NotImplementedError, shapely.errors.ShapelyError),
)


class CodecError(ValueError):
    """Bytes that are not what `encode` writes, or a value it has no form for."""


def encode(value: Any) -> bytes:
    """A value out of plain numbers, strings, lists, tuples, dicts, arrays, shapely geometries and the known classes.

    A ValueError refuses what there is no form for, and fields of a known class that hold else than the class states.
    """
    writer = _Writer()
    text = json.dumps(writer.plain(value), separators=(",", ":")).encode()
    return b"".join((_LENGTH.pack(len(text)), text, *writer.buffers))


def decode(data: bytes, hint: Any = None) -> Any:
    """Inverse of `encode`; arrays are C-contiguous copies of their own. `hint`: type of what it should be, or anything.

    A CodecError says that bytes are not of this form, name a class that is none of ours, or make no such object.
    """
    try:
        (size,) = _LENGTH.unpack_from(data)
        text, buffers = data[_LENGTH.size : _LENGTH.size + size], memoryview(data)[_LENGTH.size + size :]
        value = _Reader(buffers).value(json.loads(text))
    except CodecError:
        raise
    except _WRONG_BYTES as error:
        why = " ".join(str(error).split())[:80] or type(error).__name__
        raise CodecError(f"expected a record of a session, got other bytes ({why})") from error
    if hint is not None and not holds(value, hint):
        raise CodecError(f"expected a record of {hint}, got {type(value).__name__}")
    return value


def without_scans(keyframe: Keyframe) -> dict[str, Any]:
    """The fields of a keyframe that the estimator needs: all but its raw scans."""
    return {field.name: getattr(keyframe, field.name) for field in fields(keyframe) if field.name != "scans"}


def keyframe_of(data: bytes) -> Keyframe:
    """A keyframe out of the bytes of `without_scans`."""
    values = decode(data)
    try:
        made = Keyframe(**values)
        check_fields("keyframe", made)
    except (TypeError, ValueError) as error:
        raise CodecError(f"expected the fields of a keyframe, got others ({error})") from error
    return made


class _Writer:
    def __init__(self) -> None:
        self.buffers: list[bytes] = []
        self._end = 0

    def plain(self, value: Any) -> Any:
        kind = type(value)
        if _CLASSES.get(kind.__name__) is kind:
            check_fields(kind.__name__, value)  # as the reader will: what it would refuse must not be written
            content = {one.name: self.plain(getattr(value, one.name)) for one in fields(value)}
            return {"class": kind.__name__, "fields": content}
        if isinstance(value, np.ndarray):
            return {"array": self._array(value)}
        if value is None or isinstance(value, int | float | str):
            return value
        if isinstance(value, np.generic):
            return self.plain(value.item())
        if isinstance(value, tuple):
            return {"tuple": [self.plain(one) for one in value]}
        if isinstance(value, BaseGeometry):
            return {"shape": self._put(shapely.to_wkb(value, byte_order=1))}  # type: ignore[arg-type]
        if isinstance(value, dict):
            if not all(isinstance(key, str) for key in value):
                raise CodecError(f"expected names as keys, got {list(value)!r:.60}")
            return {"dict": {key: self.plain(one) for key, one in value.items()}}
        if isinstance(value, Stored):
            return self.plain(value.loaded())
        if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray):
            return [self.plain(one) for one in value]
        raise CodecError(f"expected a measurement that a session knows, got {kind.__name__}")

    def _array(self, value: np.ndarray) -> list[Any]:
        little = value.dtype.str.replace(">", "<")
        if little not in _NUMBERS:
            raise CodecError(f"expected an array of numbers, got one of {value.dtype}")
        return [little, list(value.shape), *self._put(value.astype(little, copy=False).tobytes())]

    def _put(self, data: bytes) -> list[int]:
        start, self._end = self._end, self._end + len(data)
        self.buffers.append(data)
        return [start, len(data)]


class _Reader:
    def __init__(self, buffers: memoryview) -> None:
        self._buffers = buffers

    def value(self, plain: Any) -> Any:
        if isinstance(plain, list):
            return [self.value(one) for one in plain]
        if not isinstance(plain, dict):
            return plain
        kind = next(iter(plain), None)
        content: Any = plain[kind] if kind else None
        if kind == "array":
            return self._array(*content)
        if kind == "tuple":
            return tuple(self.value(one) for one in content)
        if kind == "shape":
            return self._shape(*content)
        if kind == "dict":
            return {key: self.value(one) for key, one in content.items()}
        if kind == "class" and content in _CLASSES:
            made = _CLASSES[content](**{key: self.value(one) for key, one in plain["fields"].items()})
            check_fields(content, made)
            return made
        unknown = content if kind == "class" else kind
        raise CodecError(f"expected a record of a session, got an unknown {str(unknown)!r:.60}")

    def _shape(self, start: int, size: int) -> Any:
        with np.errstate(invalid="ignore"):  # a NaN that signals
            found = shapely.from_wkb(bytes(self._get(start, size)))
        if not np.isfinite(shapely.get_coordinates(found)).all():
            raise CodecError("expected the outline of a plane, got one that is not finite")
        return found

    def _array(self, name: str, shape: list[int], start: int, size: int) -> np.ndarray:
        kind = _NUMBERS.get(name)
        if kind is None or min(shape, default=0) < 0:
            raise CodecError(f"expected an array of numbers, got {name:.20} of shape {str(shape)[:60]}")
        flat = np.frombuffer(self._get(start, size), dtype=kind).reshape(shape)
        return flat.copy() if kind.isnative else flat.astype(kind.newbyteorder("="))

    def _get(self, start: int, size: int) -> memoryview:
        if not 0 <= start <= start + size <= len(self._buffers):
            raise CodecError("expected a record of a session, got one that breaks off")
        return self._buffers[start : start + size]
