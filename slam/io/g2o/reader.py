"""g2o files with poses and planes as GTSAM graphs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import gtsam_unstable
import numpy as np

from factors.robust import gaussian
from slam.errors import LogError
from slam.geometry.frames import norms_of
from slam.io.g2o._tangents import POSE_JACOBIAN, plane_jacobian, root_information
from slam.io.raw import floats_of, line_named, numbered_words
from spplanes._check import TOO_LARGE, FloatArray

#: Vertices that a file may have: more cannot be numbered by a GTSAM symbol, and none has.
_MOST_VERTICES = 10_000_000


class G2oEdge(NamedTuple):
    """An edge as it stands in a g2o file."""

    kind: str
    """Its first word."""
    ids: tuple[int, ...]
    """Of its vertices, and of the sensor."""
    numbers: FloatArray
    """What was measured, of a plane a colour, and the upper half of the information matrix, row by row."""
    line: int
    """Where it stands."""

    @property
    def measured(self) -> FloatArray:
        """A pose (x, y, z, qx, qy, qz, qw), shape (7,), or a plane in the sensor's frame, shape (4,)."""
        return self.numbers[: 4 if self.kind == "EDGE_SE3_PLANE_CALIB" else 7]


@dataclass(frozen=True, eq=False)
class G2oGraph:
    """The graph of a g2o file."""

    graph: gtsam.NonlinearFactorGraph
    """Odometry, priors, sightings of planes, and priors of 1e-6 m and rad that hold the fixed vertices."""
    values: gtsam.Values
    """Poses (Pose3) and planes (OrientedPlane3), as the file has them; planes in the world."""
    poses: dict[int, int]
    """GTSAM key of every pose, by vertex id: symbol x and the id."""
    planes: dict[int, int]
    """GTSAM key of every plane, by vertex id: symbol p and the id."""
    edges: list[G2oEdge] = field(default_factory=list)
    """As the file has them, in its order."""


def read_g2o(path: Path | str) -> G2oGraph:
    """Read a g2o file of poses and planes.

    It may hold ``VERTEX_SE3:QUAT``, ``VERTEX_PLANE``, ``EDGE_SE3:QUAT``, ``EDGE_SE3_PRIOR``, ``EDGE_SE3_PLANE_CALIB``,
    ``PARAMS_SE3OFFSET`` (the body itself) and ``FIX``.

    Planes live in the frame of one more pose, symbol w0, held at the origin: with it every sighting has a native
    factor. Errors are those of g2o's edges to first order. Information may be of any rank.

    Raises:
        LogError: one sentence with file and line: a word that is none of these, too few numbers, numbers that are not
            finite, a quaternion or a normal that is not one, an id given twice or missing, an information matrix that
            is not positive semidefinite, a sensor that is not a fixed vertex, or no pose at all.
    """
    path = Path(path)
    reader = _Reader()
    for line, words in numbered_words(path):
        with line_named(path, line):
            reader.read(line, words)
    return reader.graph(path)


@dataclass
class _Reader:
    """What was read so far."""

    poses: dict[int, gtsam.Pose3] = field(default_factory=dict)
    planes: dict[int, gtsam.OrientedPlane3] = field(default_factory=dict)
    fixed: dict[int, int] = field(default_factory=dict)
    offsets: dict[int, gtsam.Pose3] = field(default_factory=dict)
    edges: list[G2oEdge] = field(default_factory=list)

    def read(self, line: int, words: list[str]) -> None:
        """Take a line; a ValueError says what is wrong with it."""
        kind = words[0]
        if kind == "FIX":
            self.fixed.update((_id(word), line) for word in words[1:])
        elif kind in _VERTICES:
            (number,), numbers = _split(words, 1, 7)
            kept: dict[int, Any] = {"VERTEX_PLANE": self.planes, "PARAMS_SE3OFFSET": self.offsets}.get(kind, self.poses)
            taken = number in kept if kind == "PARAMS_SE3OFFSET" else number in self.poses or number in self.planes
            if taken:
                raise ValueError(f"expected each id once, got {number} again")
            if len(kept) >= _MOST_VERTICES:
                raise ValueError(f"expected at most {_MOST_VERTICES} vertices")
            kept[number] = _plane(numbers) if kind == "VERTEX_PLANE" else _pose(numbers)
        elif kind in _EDGES:
            self.edges.append(G2oEdge(kind, *_split(words, *_EDGES[kind]), line))
        else:
            raise ValueError(f"expected one of {', '.join([*_VERTICES, *_EDGES, 'FIX'])}, got {kind[:40]!r}")

    def graph(self, path: Path) -> G2oGraph:
        """The graph of all that was read; a LogError where something in it does not fit."""
        if not self.poses:
            raise LogError(path, "expected at least one VERTEX_SE3:QUAT, got none")
        for number, line in self.fixed.items():
            if number not in self.poses:
                raise LogError(path, f"expected a pose to fix, got the id {number}", line=line)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        sensors = {edge.ids[2] for edge in self.edges if edge.kind == "EDGE_SE3_PLANE_CALIB"}
        used = {number for edge in self.edges for number in edge.ids[: _POSES_OF[edge.kind]]}
        poses = {number: gtsam.symbol("x", number) for number in self.poses if number not in sensors - used}
        planes = {number: gtsam.symbol("p", number) for number in self.planes}
        for number, key in sorted(poses.items()):
            values.insert(key, self.poses[number])
            if number in self.fixed:
                graph.push_back(_held(key, self.poses[number]))
        if self.planes:
            values.insert(_WORLD, gtsam.Pose3())
            graph.push_back(_held(_WORLD, gtsam.Pose3()))
        for number, key in sorted(planes.items()):
            values.insert(key, self.planes[number])
        for edge in self.edges:
            with line_named(path, edge.line):
                graph.push_back(self._factor(edge))
        return G2oGraph(graph, values, poses, planes, self.edges)

    def _factor(self, edge: G2oEdge) -> gtsam.NonlinearFactor:
        keys = []
        for number in edge.ids[: _POSES_OF[edge.kind]]:
            _known(self.poses, number, "pose")
            keys.append(gtsam.symbol("x", number))
        if edge.kind == "EDGE_SE3_PLANE_CALIB":
            return self._sighting(edge, keys[0])
        root = root_information(edge.numbers[7:], 6) @ POSE_JACOBIAN
        measured = _pose(edge.measured)
        if edge.kind == "EDGE_SE3:QUAT":
            return gtsam.BetweenFactorPose3(keys[0], keys[1], measured, _noise(root))
        if not _known(self.offsets, edge.ids[1], "PARAMS_SE3OFFSET").equals(gtsam.Pose3(), 1e-12):
            raise ValueError("expected a prior on the pose itself, got one with an offset")
        return _prior(keys[0], measured, root)

    def _sighting(self, edge: G2oEdge, pose_key: int) -> gtsam.NonlinearFactor:
        _, plane, sensor = edge.ids
        _known(self.planes, plane, "plane")
        body_T_sensor = _known(self.poses, sensor, "pose")
        if sensor not in self.fixed:
            raise ValueError(f"expected a fixed sensor, got the free vertex {sensor}")
        in_sensor = _plane(edge.measured)
        measured = in_sensor.transform(body_T_sensor.inverse())
        in_g2o = plane_jacobian(in_sensor, np.eye(3)) @ _to_sensor(in_sensor, measured, body_T_sensor)
        noise = _noise(root_information(edge.numbers[7:], 3) @ in_g2o)
        plane_key = gtsam.symbol("p", plane)
        return gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, pose_key, _WORLD, plane_key)


def _known(kept: dict[int, Any], number: int, what: str) -> Any:
    if number not in kept:
        raise ValueError(f"expected the id of a {what}, got {number}")
    return kept[number]


def _split(words: list[str], ids: int, size: int) -> tuple[tuple[int, ...], FloatArray]:
    if len(words) != 1 + ids + size:
        raise ValueError(f"expected {ids + size} numbers after {words[0]}, got {len(words) - 1}")
    numbers = np.array(floats_of(words[1 + ids :]))
    if np.abs(numbers).max() >= TOO_LARGE:
        raise ValueError(f"expected numbers below {TOO_LARGE:g}, got larger ones")
    return tuple(map(_id, words[1 : 1 + ids])), numbers


def _id(word: str) -> int:
    if not (word.isdecimal() and len(word) <= 15):
        raise ValueError(f"expected an id, a whole number, got {word[:20]!r}")
    return int(word)


def _pose(numbers: FloatArray) -> gtsam.Pose3:
    norms, wrong = norms_of(numbers[None, 3:7])
    if wrong[0]:
        raise ValueError(f"expected a unit quaternion, got one of norm {norms[0]:.6g}")
    x, y, z, w = numbers[3:7] / norms[0]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), numbers[:3])


def _plane(numbers: FloatArray) -> gtsam.OrientedPlane3:
    norm = np.linalg.norm(numbers[:3])
    if norm == 0.0:
        raise ValueError("expected the normal of a plane, got zero")
    return gtsam.OrientedPlane3(numbers[:4] / norm)


def _to_sensor(
    in_sensor: gtsam.OrientedPlane3, in_body: gtsam.OrientedPlane3, body_T_sensor: gtsam.Pose3
) -> FloatArray:
    """Derivative (3, 3) of a plane's error in the sensor's frame by that in the body's, both as GTSAM writes it."""
    axes = in_body.normal().basis()
    jacobian = np.eye(3)
    jacobian[:2, :2] = in_sensor.normal().basis().T @ body_T_sensor.rotation().matrix().T @ axes
    jacobian[2, :2] = -body_T_sensor.translation() @ axes  # d in the sensor's frame is d - n . translation
    return jacobian


def _prior(key: int, measured: gtsam.Pose3, root: FloatArray) -> gtsam.NonlinearFactor:
    """Prior on a pose; one on the position or the rotation alone does not mix them, as GTSAM's whole one would."""
    if not root[:, :3].any():
        return gtsam.PoseTranslationPrior3D(
            key, measured.translation(), _noise(root[:, 3:] @ measured.rotation().matrix().T)
        )
    if not root[:, 3:].any():
        return gtsam.PoseRotationPrior3D(key, measured.rotation(), _noise(root[:, :3]))
    return gtsam.PriorFactorPose3(key, measured, _noise(root))


def _noise(root: FloatArray) -> gtsam.noiseModel.Base:
    """Noise model with |root e|^2 as its squared norm; `root` has as many columns as e has components."""
    return gaussian(np.asarray(np.linalg.qr(root, mode="r")), None, root.shape[1])


def _held(key: int, pose: gtsam.Pose3) -> gtsam.PriorFactorPose3:
    """A prior of 1e-6 m and rad, far below what sensors measure, and still well conditioned.

    GTSAM's solvers take no constraint by default: LM stops at once without a word, the others throw.
    """
    return gtsam.PriorFactorPose3(key, pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))


_WORLD = gtsam.symbol("w", 0)
#: All have an id and seven numbers.
_VERTICES = ("VERTEX_SE3:QUAT", "VERTEX_PLANE", "PARAMS_SE3OFFSET")
#: Number of ids, and of numbers after them.
_EDGES = {"EDGE_SE3:QUAT": (2, 28), "EDGE_SE3_PRIOR": (2, 28), "EDGE_SE3_PLANE_CALIB": (3, 13)}
#: How many of the ids, from the first, are poses that the error depends on.
_POSES_OF = {"EDGE_SE3:QUAT": 2, "EDGE_SE3_PRIOR": 1, "EDGE_SE3_PLANE_CALIB": 1}
