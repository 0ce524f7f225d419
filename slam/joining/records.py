"""Missions and comparisons as bytes and back: numbers, text and outlines alone, so that nothing in them is ever run."""

from __future__ import annotations

import json
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
_HEAD = f"spplanes-mission/1 {__version__}\n".encode()


class RecordError(ValueError):
    """Bytes that are no record of this version, or not those that were written."""


def mission_to_bytes(mission: Mission) -> bytes:
    """A mission without its graph."""
    return _sealed(_plain_mission(mission))


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
            **_plain_mission(finished.mission),
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
    known = one.alignment
    alignment = None
    if known is not None:
        alignment = {
            "a_T_b": known.a_T_b,
            "covariance": known.covariance,
            "pairs": np.array(known.pairs, dtype=np.int64).reshape(-1, 2),
            "numbers": [known.chi2, known.n_dof, known.worst],
        }
    words = [one.first, one.second, one.verdict, one.reason]
    numbers = [one.evidence, one.looks, one.through]
    moved = np.array(one.moved, dtype=np.int64).reshape(-1, 2)
    return _sealed({"words": words, "numbers": numbers, "moved": moved, "alignment": alignment})


def comparison_from_bytes(data: bytes) -> Comparison:
    """Inverse of `comparison_to_bytes`."""
    plain = _opened(data)
    try:
        alignment, known = None, plain["alignment"]
        if known is not None:
            pairs = tuple((i, j) for i, j in known["pairs"].tolist())
            alignment = Alignment(known["a_T_b"], known["covariance"], pairs, *known["numbers"])
        first, second, verdict, reason = plain["words"]
        evidence, looks, through = plain["numbers"]
        moved = tuple((i, j) for i, j in plain["moved"].tolist())
        return Comparison(first, second, verdict, reason, alignment, evidence, looks, through, moved)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordError("expected the record of a comparison, got another") from error


def _plain_mission(mission: Mission) -> dict[str, Any]:
    return {
        "name": mission.name,
        "planes": list(mission.planes),
        "covariance": mission.covariance,
        "stamps_ns": mission.trajectory.stamps_ns,
        "poses": mission.trajectory.poses,
        "looks": [
            {
                "mission_T_body": one.mission_T_body,
                "returns": one.returns,
                "planes": list(one.planes),
                "body_T_sensor": one.body_T_sensor,
            }
            for one in mission.looks
        ],
    }


def _mission_of(plain: dict[str, Any]) -> Mission:
    try:
        looks: list[dict[str, Any]] = [{**one, "planes": tuple(one["planes"])} for one in plain["looks"]]
        trajectory = Trajectory(plain["stamps_ns"], plain["poses"])
        return Mission(
            plain["name"], tuple(plain["planes"]), plain["covariance"], trajectory, tuple(Look(**one) for one in looks)
        )
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
