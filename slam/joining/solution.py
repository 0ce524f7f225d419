"""The joint solution of missions: condensed, joined, solved, back-substituted, linearised anew until nothing moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import gtsam
import numpy as np

from factors import anchored_plane_jacobian, pose_prior
from slam.joining.alignment import LEVEL_SIGMA_M, LEVEL_SIGMA_RAD
from slam.joining.condensation import Condensed, Solved, condense, renamed
from slam.joining.mission import MissionGraph
from slam.mapping.same_plane import anchored_difference
from spplanes._check import FloatArray

#: A plane is itself: what two landmarks that are one may differ by, rad and m. As far below what is measured as the
#: prior of a map is (`slam.session.prior_map`), and no further, for the root of the information is solved by QR.
_SAME = 1e-6
#: Keys of the missions of one graph are this far apart.
_APART = 1 << 40


@dataclass(frozen=True, order=True)
class Place:
    """A landmark, by its id, of a mission, by its number."""

    mission: int
    landmark: int


@dataclass(frozen=True, order=True)
class Tie:
    """Two landmarks of two missions that are one plane."""

    first: Place
    second: Place


def joint_key(mission: int, key: int) -> int:
    """A key of a mission in a graph of many."""
    return key + (mission + 1) * _APART


def base_key(mission: int) -> int:
    """Key of common_T_mission."""
    return gtsam.symbol("b", mission)


class TiedKeys(NamedTuple):
    """Keys of one side of a tie in the graph of many missions: the mission's base, the landmark's anchor, its own."""

    base: int
    anchor: int
    plane: int


def tie_factor(first: TiedKeys, second: TiedKeys) -> gtsam.CustomFactor:
    """The factor of a tie: the difference of the planes in the frame of the second one's anchor is nothing."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        difference, blocks = tied_difference(values, first, second)
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = np.asfortranarray(block)
        return difference

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, _SAME), [*first, *second], error)


def tied_difference(
    values: gtsam.Values, first: TiedKeys, second: TiedKeys
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """How two landmarks of two missions differ, (3,), and the derivatives by the keys of the first, then the second."""
    planes, anchors, adjoints = [], [], []
    for side in (first, second):
        anchor = values.atPose3(side.anchor)
        planes.append(values.atOrientedPlane3(side.plane))
        anchors.append(values.atPose3(side.base).compose(anchor).matrix())
        adjoints.append(anchor.inverse().AdjointMap())
    difference, (by_first, by_a, by_second, by_b) = anchored_difference(planes[0], anchors[0], planes[1], anchors[1])
    return difference, (by_a @ adjoints[0], by_a, by_first, by_b @ adjoints[1], by_b, by_second)


#: The base of the first mission is the common frame: sigma of its pose, m and rad.
_EXACT = 1e-6
#: Missions whose frames lie level with the first one's, up to three times these, are on one floor, which is so even:
#: z, m, and roll and pitch, rad. Walls alone leave these open. (With 0.5 m and 0.05 rad, walls that lean within their
#: own uncertainty made the solution sway for ever.)
FLOOR_M, FLOOR_RAD = 0.02, 0.002
#: Of where the others are in it nothing is known beforehand, m and rad; no prior at all would leave nothing to solve
#: where planes say nothing.
_UNKNOWN_M, _UNKNOWN_RAD = 1e3, 1e2
#: The end: no variable moves by more than this share of its standard deviation.
SETTLED = 0.01
_ROUNDS = 50


class JoinError(ValueError):
    """Missions that cannot be solved together; the sentence says why."""


@dataclass(eq=False)
class JointSolution:
    """Missions of one component in one frame."""

    graphs: Mapping[int, MissionGraph]
    """Their factors, by number; the first one's frame is the common one."""
    starts: Mapping[int, FloatArray]
    """About where each mission's frame is in the common one, (4, 4); the first's exactly."""
    shared: Mapping[int, tuple[int, ...]]
    """Landmarks of each mission that stay in the joint graph, by id."""
    ties: tuple[Tie, ...]
    bases: dict[int, gtsam.Pose3] = field(default_factory=dict)
    """common_T_mission."""
    values: dict[int, gtsam.Values] = field(default_factory=dict)
    """Of every mission, in its own frame and by its own keys."""
    floor_sigmas: tuple[float, float] = (FLOOR_M, FLOOR_RAD)
    """How even the floor is that missions are on, as `FLOOR_M` and `FLOOR_RAD`."""

    def __post_init__(self) -> None:
        self._condensed: dict[int, Condensed] = {}
        for number, graph in self.graphs.items():
            self.bases.setdefault(number, gtsam.Pose3(self.starts[number]))
            self.values.setdefault(number, gtsam.Values(graph.values))

    def solve(self, settled: float = SETTLED) -> None:
        """Gauss and Newton over all missions, each eliminated by itself; JoinError: it does not come to an end.

        In the last step no variable moves by more than the share `settled` of its standard deviation.
        """
        for _ in range(_ROUNDS):
            self._condense()
            if self._step() <= settled:
                self._condense()
                return
        raise JoinError(f"expected missions that fit together, got some that still move after {_ROUNDS} steps")

    def chi2(self, ties: Sequence[Tie]) -> float:
        """Least squared error of the linear joint graph, with some ties."""
        linear = self._linear(ties)
        return 2.0 * float(linear.error(linear.eliminateMultifrontal(function=gtsam.EliminateQR).optimize()))

    def pose(self, mission: int, key: int) -> gtsam.Pose3:
        """common_T_body of a pose of a mission."""
        return self.bases[mission].compose(self.values[mission].atPose3(key))

    def plane(self, place: Place) -> tuple[gtsam.OrientedPlane3, FloatArray]:
        """A landmark, and the pose (4, 4) in the common frame in whose frame it lives."""
        anchor, key = self.graphs[place.mission].planes[place.landmark]
        return self.values[place.mission].atOrientedPlane3(key), self.pose(place.mission, anchor).matrix()

    def differences(self, pairs: Sequence[Tie]) -> list[tuple[FloatArray, FloatArray]]:
        """How landmarks that stay in the joint graph differ (3,), and the covariance (3, 3) of that by everything."""
        solved, values, found = Solved(self._linear(self.ties)), self._values(), []
        for pair in pairs:
            first, second = self.keys(pair.first), self.keys(pair.second)
            difference, blocks = tied_difference(values, first, second)
            jacobian = np.hstack(blocks)
            found.append((difference, jacobian @ solved.covariance([*first, *second]) @ jacobian.T))
        return found

    def keys(self, place: Place) -> TiedKeys:
        """Keys of a landmark in the joint graph."""
        anchor, plane = self.graphs[place.mission].planes[place.landmark]
        number = place.mission
        return TiedKeys(base_key(number), joint_key(number, anchor), joint_key(number, plane))

    def posterior(self, mission: int) -> MissionPosterior:
        """What all missions together say of one: for covariances in the common frame."""
        others = self._linear(self.ties, without=mission)
        own = {joint_key(mission, key): key for key in self._kept(mission)} | {base_key(mission): base_key(mission)}
        held = set(others.keys())
        told = condense(others, [key for key in own if key in held]).shared
        graph = self.graphs[mission].factors.linearize(self.values[mission])
        values = gtsam.Values(self.values[mission])
        values.insert(base_key(mission), self.bases[mission])
        graph.push_back(renamed(told, own).linearize(values))
        return MissionPosterior(mission, self, graph)

    def _kept(self, mission: int) -> list[int]:
        """Own keys of a mission that stay in the joint graph: its shared landmarks, and their anchors."""
        planes = self.graphs[mission].planes
        return sorted({key for landmark in self.shared[mission] for key in planes[landmark]})

    def _condense(self) -> None:
        self._condensed = {
            number: condense(graph.factors.linearize(self.values[number]), self._kept(number))
            for number, graph in self.graphs.items()
        }

    def _linear(self, ties: Sequence[Tie], without: int | None = None) -> gtsam.GaussianFactorGraph:
        """The joint graph, linear: missions condensed, their bases, ties."""
        graph = gtsam.NonlinearFactorGraph()
        for number, condensed in self._condensed.items():
            if number != without and condensed.shared.rows():
                graph.push_back(renamed(condensed.shared, {key: joint_key(number, key) for key in self._kept(number)}))
        for number, start in self.starts.items():
            if number == min(self.starts):
                graph.push_back(pose_prior(base_key(number), start, _EXACT**2 * np.eye(6)))
            else:
                graph.push_back(_floor_prior(base_key(number), start, *self.floor_sigmas))
        for tie in ties:
            graph.push_back(tie_factor(self.keys(tie.first), self.keys(tie.second)))
        return graph.linearize(self._values())

    def _values(self) -> gtsam.Values:
        """Of the joint graph."""
        values = gtsam.Values()
        for number, own in self.values.items():
            values.insert(base_key(number), self.bases[number])
            for key in self._kept(number):
                one = own.atPose3(key) if chr(key >> 56) in "xm" else own.atOrientedPlane3(key)
                values.insert(joint_key(number, key), one)
        return values

    def _step(self) -> float:
        """Take one step; the largest of any variable in its standard deviations."""
        solved = Solved(self._linear(self.ties))
        steps, largest = solved.steps, solved.largest()
        for number in self.graphs:
            shared = gtsam.VectorValues()
            for key in self._kept(number):
                shared.insert(key, steps.at(joint_key(number, key)))
            own, furthest = self._condensed[number].back_substituted(shared)
            self.values[number] = self.values[number].retract(own)
            self.bases[number] = self.bases[number].retract(steps.at(base_key(number)))
            largest = max(largest, furthest)
        return largest


@dataclass(frozen=True, eq=False)
class MissionPosterior:
    """One mission's variables with the covariance that all missions together give them."""

    mission: int
    solution: JointSolution
    graph: gtsam.GaussianFactorGraph
    """Its own factors, and what the others say of what it shares."""

    def plane_covariance(self, landmark: int, common_T_plane: FloatArray) -> FloatArray:
        """Covariance (3, 3) of (z, theta, psi) of a landmark in a plane frame (4, 4) of the common frame."""
        anchor, key = self.solution.graphs[self.mission].planes[landmark]
        joint = self._of_map.covariance([base_key(self.mission), anchor, key])
        plane, common_T_anchor = self.solution.plane(Place(self.mission, landmark))
        by_anchor_and_plane = anchored_plane_jacobian(plane, common_T_anchor, common_T_plane)
        own = self.solution.values[self.mission].atPose3(anchor)
        by_base = by_anchor_and_plane[:, :6] @ own.inverse().AdjointMap()
        jacobian = np.hstack((by_base, by_anchor_and_plane))
        return jacobian @ joint @ jacobian.T

    def pose_covariance(self, key: int) -> FloatArray:
        """Covariance (6, 6) of the tangent of common_T_body, GTSAM order, of a pose in the graph."""
        keys = [base_key(self.mission), key]
        joint = self._marginal(keys).covariance(keys)
        own = self.solution.values[self.mission].atPose3(key)
        jacobian = np.hstack((own.inverse().AdjointMap(), np.eye(6)))
        return jacobian @ joint @ jacobian.T

    @cached_property
    def _of_map(self) -> Solved:
        """Base, planes and their anchors."""
        planes = self.solution.graphs[self.mission].planes.values()
        return self._marginal(sorted({base_key(self.mission), *(key for pair in planes for key in pair)}))

    def _marginal(self, keys: Sequence[int]) -> Solved:
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(condense(self.graph, keys).shared)
        return Solved(graph)


def _floor_prior(key: int, start: FloatArray, sigma_m: float, sigma_rad: float) -> gtsam.PriorFactorPose3:
    """A mission on the floor of the first one; one that is not is held to its start, as loosely as can be solved."""
    mean = gtsam.Pose3(start)
    if abs(start[2, 3]) < 3.0 * sigma_m and np.abs(start[2, :2]).max() < 3.0 * sigma_rad:
        mean = gtsam.Pose3(gtsam.Rot3.Yaw(np.arctan2(start[1, 0], start[0, 0])), np.array([*start[:2, 3], 0.0]))
    else:
        sigma_m, sigma_rad = LEVEL_SIGMA_M, LEVEL_SIGMA_RAD
    level = (_UNKNOWN_M, _UNKNOWN_M, sigma_m, _UNKNOWN_RAD, sigma_rad, sigma_rad)
    return pose_prior(key, mean, np.diag(np.square(level)))
