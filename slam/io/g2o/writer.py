"""Graphs as g2o files: poses and planes in g2o's own vertices, odometry, priors and sightings as its edges."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import gtsam_unstable
import numpy as np

from factors import landmark_anchors
from factors._check import held
from factors._custom import Recipe, VelocityRecipe, describe
from slam.io.g2o._tangents import POSE_JACOBIAN, SENSORS, measured_plane, plane_jacobian, sensor_for
from slam.io.g2o.reader import G2oGraph
from slam.io.raw import numbered_words
from spplanes._check import FloatArray

_PLANE_RGB = "0.6 0.6 0.65"
#: GTSAM's tangent of a pose by g2o's error, at zero.
_TANGENT_BY_G2O = np.linalg.inv(POSE_JACOBIAN)


@dataclass(frozen=True)
class G2oContent:
    """What went into a g2o file, and what g2o has no word for."""

    poses: dict[int, int]
    """Vertex id of every pose, by GTSAM key."""
    planes: dict[int, int]
    """Vertex id of every plane, by GTSAM key."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Number of factors and variables that a g2o file cannot hold, by type."""


def write_g2o(path: Path | str, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> G2oContent:
    """Write a graph of poses and planes as g2o's ``VERTEX_SE3:QUAT``, ``VERTEX_PLANE`` and their edges.

    Landmarks anchored at a pose are written in the world: the same planes by other coordinates. Every factor of one
    plane becomes an ``EDGE_SE3_PLANE_CALIB`` with the factor's own information, and with what it measured so chosen
    that error and slope at ``values`` are the factor's: for `factors.plane_factor` that is its own measurement,
    exactly; a line has information of rank 2 and a measured tilt that weighs nothing. Priors on a pose, of any type,
    become ``EDGE_SE3_PRIOR``. The sensor of every edge is one of two fixed vertices at the origin of the body. Give the
    optimum as ``values``: it is then the optimum of the file, too.

    A g2o file has no robust kernels, no relations between two planes and no 2D poses beside 3D ones: kernels are
    dropped, factors without a counterpart are left out; both are counted in what comes back and said in a comment.

    Raises:
        ValueError: a factor of variables that have no value, or one landmark with two different anchors.
    """
    writer = _Writer(graph, values)
    Path(path).write_text("\n".join(writer.lines()) + "\n", encoding="ascii")
    return G2oContent(writer.poses, writer.planes, dict(writer.left_out))


def with_vertices(path: Path | str, read: G2oGraph, values: gtsam.Values) -> str:
    """Text of a g2o file that `slam.io.g2o.reader.read_g2o` read, vertices where ``values`` has them; no comments."""
    lines = []
    for _, words in numbered_words(Path(path)):
        number = int(words[1]) if words[0] in ("VERTEX_SE3:QUAT", "VERTEX_PLANE") else None
        if number in read.poses:
            words[2:] = [_pose(values.atPose3(read.poses[number]))]
        elif number in read.planes:
            words[2:6] = [_numbers(values.atOrientedPlane3(read.planes[number]).planeCoefficients())]
        lines.append(" ".join(words))
    return "\n".join(lines) + "\n"


def in_another_world(path: Path | str, read: G2oGraph, new_T_old: FloatArray) -> str:
    """Text of a g2o file that `slam.io.g2o.reader.read_g2o` read, as another world has it; no comments.

    Vertices and priors move by the rigid motion ``new_T_old`` (4, 4). What was measured of planes from the origin of
    the old world is measured from there still: that is a fixed vertex of its own. Every error stays what it was.
    """
    motion, lines = gtsam.Pose3(new_T_old), []
    sensors = {edge.ids[2] for edge in read.edges if edge.kind == "EDGE_SE3_PLANE_CALIB"}
    values = gtsam.Values()
    for number, key in read.poses.items():
        pose = read.values.atPose3(key)
        values.insert(key, pose if number in sensors else motion.compose(pose))
    for key in read.planes.values():
        values.insert(key, read.values.atOrientedPlane3(key).transform(motion.inverse()))
    origin = 1 + max([*read.poses, *read.planes, *sensors])
    for words in map(str.split, with_vertices(path, read, values).splitlines()):
        if words[0] == "EDGE_SE3_PRIOR":
            x, y, z, qx, qy, qz, qw = map(float, words[3:10])
            measured = gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
            words[3:10] = [_pose(motion.compose(measured))]
        elif words[0] == "EDGE_SE3_PLANE_CALIB" and int(words[1]) in sensors:
            words[1] = str(origin)
        lines.append(" ".join(words))
    if any(edge.kind == "EDGE_SE3_PLANE_CALIB" and edge.ids[0] in sensors for edge in read.edges):
        lines = [f"VERTEX_SE3:QUAT {origin} {_pose(motion)}", f"FIX {origin}", *lines]
    return "\n".join(lines) + "\n"


class _Writer:
    """The vertices and edges of one graph."""

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        self.values = values
        self.left_out: Counter[str] = Counter()
        poses = [key for key in sorted(values.keys()) if held(values.atPose3, key) is not None]
        planes = [key for key in sorted(values.keys()) if held(values.atOrientedPlane3, key) is not None]
        if others := values.size() - len(poses) - len(planes):
            self.left_out["variables that are neither Pose3 nor OrientedPlane3"] = others
        self.poses = {key: index for index, key in enumerate(poses)}
        self.planes = {key: len(poses) + index for index, key in enumerate(planes)}
        self._level = len(poses) + len(planes)
        self._factors: list[Any] = [graph.at(i) for i in range(graph.size()) if graph.exists(i)]
        for key in graph.keyVector():
            if not values.exists(key):
                name = gtsam.DefaultKeyFormatter(key)
                raise ValueError(f"values: expected one for every variable, got none for {name}")
        self._anchors = {plane: anchor for plane, anchor in landmark_anchors(graph).items() if anchor is not None}

    def lines(self) -> list[str]:
        """The whole file, line by line."""
        edges = [line for factor in self._factors if (line := self._edge(factor)) is not None]
        title = "# planes n.x = d: nx ny nz -d, then a colour; written by spplanes"
        left_out = [f"# left out: {count} of {kind}" for kind, count in sorted(self.left_out.items())]
        parameters = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"  # the sensor of the priors: the body itself
        return [title, *left_out, parameters, *self._vertices(), *edges]

    def _vertices(self) -> list[str]:
        lines = [f"VERTEX_SE3:QUAT {i} {_pose(self.values.atPose3(key))}" for key, i in self.poses.items()]
        for offset, rotation in enumerate(SENSORS, self._level):
            pose = gtsam.Pose3(gtsam.Rot3(rotation), np.zeros(3))
            lines += [f"VERTEX_SE3:QUAT {offset} {_pose(pose)}", f"FIX {offset}"]
        for key, i in self.planes.items():
            lines.append(f"VERTEX_PLANE {i} {_numbers(self._in_world(key).planeCoefficients())} {_PLANE_RGB}")
        return lines

    def _edge(self, factor: Any) -> str | None:
        if isinstance(factor.noiseModel(), gtsam.noiseModel.Robust):
            self.left_out["robust kernels"] += 1
        if isinstance(factor, gtsam.BetweenFactorPose3):
            return self._between(factor)
        recipe = describe(factor)
        if isinstance(recipe, VelocityRecipe):
            return self._between(self._goes_on(recipe))
        sighting = _sighting_of(factor, recipe)
        if sighting is not None and sighting.plane_key in self.planes:
            return self._plane_edge(factor, sighting)
        keys = list(factor.keys())
        if len(keys) == 1 and keys[0] in self.poses:
            return self._prior(keys[0], factor)
        self.left_out[type(factor).__name__] += 1
        return None

    def _between(self, factor: gtsam.BetweenFactorPose3) -> str:
        a, b = (self.poses[key] for key in factor.keys())  # noqa: SIM118 - not a mapping
        root = _gaussian_of(factor).R() @ _TANGENT_BY_G2O
        return f"EDGE_SE3:QUAT {a} {b} {_pose(factor.measured())} {_upper(root.T @ root)}"

    def _goes_on(self, recipe: VelocityRecipe) -> gtsam.BetweenFactorPose3:
        """A velocity that is kept as the motion that the values say: g2o has no edge of three poses."""
        a, b = (self.values.atPose3(key) for key in recipe.keys[:2])
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(recipe.root_information, False)
        return gtsam.BetweenFactorPose3(*recipe.keys[1:], recipe.expected(a.between(b)), noise)

    def _prior(self, key: int, factor: Any) -> str:
        """What it measured is where its error vanishes, found by Newton steps of least norm."""
        measured = self.values.atPose3(key)
        for _ in range(20):
            matrix, rest = _linearised(factor, {key: measured})
            step = np.linalg.lstsq(matrix, rest, rcond=1e-12)[0]
            measured = measured.retract(step)
            if np.abs(step).max() < 1e-14:
                break
        root = _linearised(factor, {key: measured})[0] @ _TANGENT_BY_G2O
        return f"EDGE_SE3_PRIOR {self.poses[key]} 0 {_pose(measured)} {_upper(root.T @ root)}"

    def _plane_edge(self, factor: Any, sighting: _Sighting) -> str:
        observer, seen = sighting.pose_key, self._in_world(sighting.plane_key)
        if observer is None and not sighting.in_world:
            observer = self._anchors.get(sighting.plane_key)
        if observer is not None:
            seen = seen.transform(self.values.atPose3(observer))
        origins = {key: gtsam.Pose3() for key in factor.keys() if key != sighting.plane_key}  # noqa: SIM118
        matrix, rest = _linearised(factor, {**origins, sighting.plane_key: seen})
        matrix = matrix[:, -3:]
        step = np.asarray(np.linalg.lstsq(matrix, -rest, rcond=1e-12)[0], dtype=np.float64)
        measured, slope = measured_plane(seen, step)
        sensor = sensor_for(measured.normal().point3())
        rotation = SENSORS[sensor]
        root = matrix @ np.linalg.inv(plane_jacobian(measured, rotation) @ slope)
        in_sensor = measured.transform(gtsam.Pose3(gtsam.Rot3(rotation), np.zeros(3)))
        pose = self._level if observer is None else self.poses[observer]
        ids = f"{pose} {self.planes[sighting.plane_key]} {self._level + sensor}"
        coefficients = _numbers(in_sensor.planeCoefficients())
        return f"EDGE_SE3_PLANE_CALIB {ids} {coefficients} {_PLANE_RGB} {_upper(root.T @ root)}"

    def _in_world(self, plane_key: int) -> gtsam.OrientedPlane3:
        landmark, anchor = self.values.atOrientedPlane3(plane_key), self._anchors.get(plane_key)
        return landmark if anchor is None else landmark.transform(self.values.atPose3(anchor).inverse())


def _pose(pose: gtsam.Pose3) -> str:
    quaternion = pose.rotation().toQuaternion()
    turn = np.array([quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()])
    return _numbers([*pose.translation(), *(turn if turn[3] >= 0.0 else -turn)])


def _upper(matrix: FloatArray) -> str:
    return _numbers(matrix[np.triu_indices(len(matrix))])


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


class _Sighting(NamedTuple):
    """Of a factor that depends on one plane, seen from one pose; of its other poses nothing matters."""

    plane_key: int
    pose_key: int | None
    """None: seen from the frame that the landmark lives in, or from the world."""
    in_world: bool = False
    """Without a pose: it speaks of the landmark in the world, though that lives in the frame of an anchor."""


def _sighting_of(factor: Any, recipe: Recipe | None) -> _Sighting | None:
    """What a factor, a custom one by its recipe, sees; None where it is no sighting of one plane."""
    if recipe is not None:
        if recipe.reference_key is not None or recipe.planar:
            return None
        in_world = recipe.pose_key is None and recipe.anchor_key is not None
        return _Sighting(recipe.plane_key, recipe.pose_key, in_world)
    keys = list(factor.keys())
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor | gtsam.OrientedPlane3Factor):
        return _Sighting(keys[-1], keys[0])
    return _Sighting(keys[0], None) if isinstance(factor, gtsam.OrientedPlane3DirectionPrior) else None


def _linearised(factor: Any, at: dict[int, gtsam.Pose3 | gtsam.OrientedPlane3]) -> tuple[FloatArray, FloatArray]:
    """Whitened Jacobian (m, n) and negative whitened error (m,) of a factor, without the weight of a robust kernel."""
    values = gtsam.Values()
    for key, value in at.items():
        values.insert(key, value)
    matrix, rest = factor.linearize(values).jacobian()
    if not isinstance(factor.noiseModel(), gtsam.noiseModel.Robust):
        return matrix, rest
    weighted, bare = np.linalg.norm(rest), np.linalg.norm(_gaussian_of(factor).whiten(factor.unwhitenedError(values)))
    scale = bare / weighted if weighted > 0.0 else 1.0
    return scale * matrix, scale * rest


def _gaussian_of(factor: Any) -> Any:
    """The noise model of a factor, without a robust kernel."""
    noise = factor.noiseModel()
    return noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
