"""Missions and comparisons as bytes and back: numbers, text and outlines alone, so that nothing in them is ever run."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import numpy as np

from factors.archive import ArchiveError, dumps, loads
from slam.config import SlamConfig
from slam.io.trajectories import Trajectory
from slam.joining.alignment import Alignment
from slam.joining.mission import FinishedMission, Look, Mission, MissionGraph
from slam.joining.overlap import Comparison
from slam.sensors.rig import Rig
from slam.session._codec import CodecError, decode, encode
from slam.session._file import digest
from slam.session.store import rig_json
from spplanes import __version__

#: What a record begins with: its form, and the version that wrote it.
_HEAD = f"spplanes-mission/2 {__version__}\n".encode()


class RecordError(ValueError):
    """Bytes that are no record of this version, or not those that were written."""


def mission_to_bytes(mission: Mission) -> bytes:
    """A mission without its graph."""
    return _sealed({"mission": _plain_mission(mission)})


def mission_from_bytes(data: bytes) -> Mission:
    """Inverse of `mission_to_bytes`, and of `finished_to_bytes` without the graph."""
    return _mission_of(_opened(data))


def finished_to_bytes(finished: FinishedMission) -> bytes:
    """A mission with its graph.

    Raises:
        ArchiveError: a factor that is not ours.
    """
    graph = finished.graph
    return _sealed(
        {
            "mission": _plain_mission(finished.mission),
            "factors": dumps(graph.factors, graph.values),
            "landmarks": np.array([(one, *keys) for one, keys in graph.planes.items()], dtype=np.int64).reshape(-1, 3),
            "carriers": np.array(graph.carriers, dtype=np.int64),
            "carrier_T_body": graph.carrier_T_body,
            "config": json.dumps(finished.config.model_dump(mode="json")),
            "rig": None if finished.rig is None else rig_json(finished.rig).decode(),
        }
    )


def finished_from_bytes(data: bytes) -> FinishedMission:
    """Inverse of `finished_to_bytes`."""
    plain = _opened(data)
    try:
        factors, values = loads(plain["factors"])
        planes = {one: (anchor, key) for one, anchor, key in plain["landmarks"].tolist()}
        graph = MissionGraph(factors, values, planes, tuple(plain["carriers"].tolist()), plain["carrier_T_body"])
        rig = None if plain["rig"] is None else Rig.model_validate_json(plain["rig"])
        return FinishedMission(_mission_of(plain), graph, SlamConfig.model_validate(json.loads(plain["config"])), rig)
    except (ArchiveError, KeyError, TypeError) as error:
        raise RecordError("expected the record of a mission with its graph, got another") from error


def comparison_to_bytes(one: Comparison) -> bytes:
    """A comparison."""
    alignment = None if one.alignment is None else _fields_of(one.alignment)
    return _sealed({**_fields_of(one), "alignment": alignment})


def comparison_from_bytes(data: bytes) -> Comparison:
    """Inverse of `comparison_to_bytes`."""
    plain = _opened(data)
    try:
        alignment = None if plain["alignment"] is None else Alignment(**plain["alignment"])
        plain |= {"alignment": alignment}
        return Comparison(**plain)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordError("expected the record of a comparison, got another") from error


def _fields_of(one: Any) -> dict[str, Any]:
    """A dataclass as a dict of its fields, these as they are."""
    return {field.name: getattr(one, field.name) for field in fields(one)}


def _plain_mission(mission: Mission) -> dict[str, Any]:
    trajectory, looks = _fields_of(mission.trajectory), [_fields_of(one) for one in mission.looks]
    return {**_fields_of(mission), "trajectory": trajectory, "looks": looks}


def _mission_of(plain: dict[str, Any]) -> Mission:
    try:
        known: dict[str, Any] = plain["mission"]
        trajectory, looks = Trajectory(**known["trajectory"]), tuple(Look(**one) for one in known["looks"])
        known |= {"trajectory": trajectory, "looks": looks}
        return Mission(**known)
    except (KeyError, TypeError) as error:
        raise RecordError("expected the record of a mission, got another") from error


def _sealed(plain: dict[str, Any]) -> bytes:
    content = encode(plain)
    return _HEAD + digest(content) + content


def _opened(data: bytes) -> dict[str, Any]:
    if not data.startswith(_HEAD):
        told = json.dumps(data[:40].split(b"\n")[0].decode("ascii", "replace"))
        raise RecordError(f"expected a record of this version, got one that begins with {told}")
    size = len(digest(b""))
    content = data[len(_HEAD) + size :]
    if digest(content) != data[len(_HEAD) : len(_HEAD) + size]:
        raise RecordError("expected a record as it was written, got one that is damaged")
    try:
        return decode(content)
    except CodecError as error:
        raise RecordError(str(error)) from error
