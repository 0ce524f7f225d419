"""A finished mission as joining needs it: planes with their joint covariance, poses, what keyframes saw; as bytes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from factors.archive import ArchiveError, dumps, loads
from factors.association.observations import planes_of
from slam.backend.estimator import BackendError
from slam.config import SlamConfig
from slam.geometry.frames import evenly
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.planeslam import PlaneSlam, pose_symbol
from slam.sensors.rig import Rig
from slam.session._codec import CodecError, decode, encode
from slam.session._file import digest
from slam.session.opening import session_path
from slam.session.prior_map import PriorMap, map_covariance
from slam.session.store import Session, SessionError
from spplanes import Plane, __version__
from spplanes._check import FloatArray

#: Keyframes that are held against another mission, evenly over the run: the sample of a long one is as good.
_MOST_LOOKS = 60
#: What the record of a mission begins with: its form, and the version that wrote it.
_HEAD = f"spplanes-mission/2 {__version__}\n".encode()


class RecordError(ValueError):
    """Bytes that are no record of this version, or not those that were written."""


@dataclass(frozen=True, eq=False)
class Look:
    """What one keyframe saw, to be held against another mission's map."""

    mission_T_body: FloatArray
    """Its pose in the mission's frame, shape (4, 4)."""
    returns: FloatArray | None
    """Beams of level lasers in the body frame, rows (x0, y0, x1, y1), shape (B, 4), m; None without."""
    planes: tuple[Plane, ...]
    """Planes seen, in the body frame."""
    body_T_sensor: FloatArray
    """From where these were seen, shape (4, 4)."""


@dataclass(frozen=True, eq=False)
class Mission:
    """What is known of a finished mission without its graph: this is what travels."""

    name: str
    """What it is called in the joined map."""
    planes: tuple[MapPlane, ...]
    """Its map, in the mission's own frame."""
    covariance: FloatArray
    """Of the (z, theta, psi) of all planes in their frames, stacked, shape (3 N, 3 N)."""
    trajectory: Trajectory
    """mission_T_body of every keyframe."""
    looks: tuple[Look, ...]
    """What some keyframes saw."""

    @classmethod
    def of_prior(cls, prior: PriorMap) -> Mission:
        """A prior map as a mission that nobody drove."""
        return cls("prior map", tuple(prior.planes), prior.covariance, Trajectory.empty(), ())

    def covariance_of(self, rows: np.ndarray) -> FloatArray:
        """Joint covariance (3 K, 3 K) of the planes at some places of `planes`, in that order."""
        columns = (3 * np.asarray(rows, dtype=np.intp)[:, None] + np.arange(3)).ravel()
        return self.covariance[np.ix_(columns, columns)]


@dataclass(frozen=True, eq=False)
class MissionGraph:
    """The factors of a mission: these stay where they are."""

    factors: gtsam.NonlinearFactorGraph
    """All that was measured."""
    values: gtsam.Values
    """The mission's own estimate, in its own frame."""
    planes: dict[int, tuple[int, int]]
    """(anchor key, own key) of every plane of the map, by landmark id."""
    carriers: tuple[int, ...]
    """For every keyframe the key of the pose in the graph that it moves with: its own where it is in the graph."""
    carrier_T_body: FloatArray
    """Where each is from there, shape (N, 4, 4)."""


@dataclass(frozen=True, eq=False)
class FinishedMission:
    """A mission with its graph."""

    mission: Mission
    graph: MissionGraph
    config: SlamConfig
    """How it was made."""
    rig: Rig | None = None
    """With which sensors."""

    @classmethod
    def of(cls, name: str, slam: PlaneSlam, rig: Rig | None = None) -> FinishedMission:
        """From an estimator whose run has ended.

        Raises:
            ValueError: it localised in a prior map, whose planes would count twice; or its graph leaves planes open.
        """
        if slam.prior is not None:
            raise ValueError(
                f"{name}: expected a mission of its own, got one that knew a prior map; join the mission that made it"
            )
        planes = tuple(slam.planes)
        try:
            covariance = map_covariance(planes, slam.landmarks, slam.backend)
        except BackendError as error:
            raise ValueError(f"{name}: expected a graph that holds every plane, got one that does not") from error
        trajectory = slam.trajectory
        carried = [slam.backend.rigid_base(pose_symbol(index)) for index in range(len(trajectory))]
        graph = MissionGraph(
            slam.backend.graph,
            gtsam.Values(slam.backend.values),
            {plane.id: (slam.landmarks[plane.id].anchor_key, slam.landmarks[plane.id].key) for plane in planes},
            tuple(key for key, _ in carried),
            np.array([pose for _, pose in carried]).reshape(-1, 4, 4),
        )
        mission = Mission(name, planes, covariance, trajectory, _looks(slam, trajectory, rig))
        return cls(mission, graph, slam.config, rig)

    @classmethod
    def open(cls, path: Path | str, name: str | None = None) -> FinishedMission:
        """Out of the folder of a finished run: its session is replayed.

        Raises:
            ValueError: no run, one that is not finished, a damaged session, one of another version.
        """
        path = Path(path)
        with Session.open(session_path(path), read_only=True) as session:
            if not session.is_finished:
                raise SessionError(f"{path}: expected a finished run, got one that is not; go on with --resume {path}")
            rig = session.rig
        with PlaneSlam.open(path, read_only=True) as slam:
            return cls.of(name or path.name, slam, rig)

    def to_bytes(self) -> bytes:
        """A record of numbers, text and outlines alone, so that nothing in it is ever run; errors of `dumps`."""
        mission, graph = self.mission, self.graph
        trajectory, looks = vars(mission.trajectory), [vars(look) for look in mission.looks]
        landmarks = [(one, *keys) for one, keys in graph.planes.items()]
        content = encode(
            {
                "mission": {**vars(mission), "trajectory": trajectory, "looks": looks},
                "factors": dumps(graph.factors, graph.values),
                "landmarks": np.array(landmarks, dtype=np.int64).reshape(-1, 3),
                "carriers": np.array(graph.carriers, dtype=np.int64),
                "carrier_T_body": graph.carrier_T_body,
                "config": json.dumps(self.config.model_dump(mode="json")),
                "rig": None if self.rig is None else json.dumps(self.rig.to_plain()),
            }
        )
        return _HEAD + digest(content) + content

    @classmethod
    def from_bytes(cls, data: bytes) -> FinishedMission:
        """Inverse of `to_bytes`; a RecordError where it is not that."""
        plain = _opened(data)
        try:
            factors, values = loads(plain["factors"])
            planes = {one: (anchor, key) for one, anchor, key in plain["landmarks"].tolist()}
            graph = MissionGraph(factors, values, planes, tuple(plain["carriers"].tolist()), plain["carrier_T_body"])
            known: dict[str, Any] = plain["mission"]
            known |= {"trajectory": Trajectory(**known["trajectory"])}
            known |= {"looks": tuple(Look(**one) for one in known["looks"])}
            rig = None if plain["rig"] is None else Rig.model_validate_json(plain["rig"])
            return cls(Mission(**known), graph, SlamConfig.model_validate(json.loads(plain["config"])), rig)
        except (ArchiveError, KeyError, TypeError) as error:
            raise RecordError("expected the record of a mission with its graph, got another") from error


def _opened(data: bytes) -> dict[str, Any]:
    """What stands in a record that is as it was written."""
    if not data.startswith(_HEAD):
        told = json.dumps(data[:40].split(b"\n")[0].decode("ascii", "replace"))
        raise RecordError(f"expected a record of this version, got one that begins with {told}")
    start = len(_HEAD) + len(digest(b""))
    if digest(data[start:]) != data[len(_HEAD) : start]:
        raise RecordError("expected a record as it was written, got one that is damaged")
    try:
        return decode(data[start:])
    except CodecError as error:
        raise RecordError(str(error)) from error


def _looks(slam: PlaneSlam, trajectory: Trajectory, rig: Rig | None) -> tuple[Look, ...]:
    sensors = [] if rig is None else list(rig.of_kind("cloud").values())
    eye = sensors[0].body_T_sensor if sensors else np.eye(4)
    looks = []
    for index in evenly(len(trajectory), _MOST_LOOKS):
        frame = slam.keyframes[index]
        looks.append(Look(trajectory.poses[index], frame.returns, tuple(planes_of(frame.observations)), eye))
    return tuple(looks)
