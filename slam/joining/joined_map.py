"""The joined map: planes seen by several missions once, trajectories in one frame, covariances by all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from factors import landmark_hesse
from slam.geometry.frames import inverse, settle_frame
from slam.geometry.polygons import flatten, largest_polygon
from slam.io.trajectories import Trajectory
from slam.joining.mission import FinishedMission
from slam.joining.overlap import Comparison
from slam.joining.solution import JointSolution, MissionPosterior, Place
from slam.map.map_planes import MapPlane
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.outlines.extents import Extent


@dataclass(frozen=True, eq=False)
class JoinedComponent:
    """Missions that overlap, solved together. The first one's frame is the common one."""

    missions: tuple[FinishedMission, ...]
    """In the order in which they were given."""
    solution: JointSolution
    """Where everything is; missions go by their place in `missions`."""
    classes: tuple[tuple[Place, ...], ...]
    """Landmarks that are one plane, each class ascending; every plane of every map is in one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the missions."""
        return tuple(mission.mission.name for mission in self.missions)

    @property
    def common_T_mission(self) -> dict[str, FloatArray]:
        """Frame of each mission in the common one, (4, 4)."""
        return {name: self.solution.bases[number].matrix() for number, name in enumerate(self.names)}

    @cached_property
    def planes(self) -> list[MapPlane]:
        """The map, numbered in the order of the missions, with the covariance by all that they saw."""
        return [self._plane(number, places) for number, places in enumerate(self.classes)]

    @cached_property
    def trajectories(self) -> dict[str, Trajectory]:
        """common_T_body of every keyframe of every mission."""
        found = {}
        for number, mission in enumerate(self.missions):
            carriers = [self.solution.pose(number, key).matrix() for key in mission.graph.carriers]
            poses = np.array(carriers).reshape(-1, 4, 4) @ mission.graph.carrier_T_body
            found[mission.mission.name] = Trajectory(mission.mission.trajectory.stamps_ns, poses)
        return found

    @property
    def trajectory(self) -> Trajectory:
        """All keyframes in time order where no two are of one time, else those of the first mission."""
        every = list(self.trajectories.values())
        stamps = np.concatenate([one.stamps_ns for one in every])
        if len(np.unique(stamps)) < len(stamps):
            return every[0]
        order = np.argsort(stamps)
        return Trajectory(stamps[order], np.concatenate([one.poses for one in every])[order])

    @property
    def odometry(self) -> Trajectory:
        """Empty: what wheels say of many missions is no trajectory."""
        return Trajectory.empty()

    @property
    def seen_by(self) -> dict[int, dict[str, int]]:
        """By plane the missions that saw it, with its landmark in each."""
        return {
            number: {self.names[place.mission]: place.landmark for place in places}
            for number, places in enumerate(self.classes)
        }

    def pose_covariance(self, mission: int, keyframe: int) -> FloatArray:
        """Covariance (6, 6) of the tangent of common_T_body, GTSAM order, of a keyframe; ValueError: it has left."""
        graph = self.missions[mission].graph
        if not np.array_equal(graph.carrier_T_body[keyframe], np.eye(4)):
            raise ValueError(f"keyframe: expected one that is in the graph, got {keyframe}, which has left it")
        return self._posteriors[mission].pose_covariance(graph.carriers[keyframe])

    @cached_property
    def _posteriors(self) -> dict[int, MissionPosterior]:
        return {number: self.solution.posterior(number) for number in range(len(self.missions))}

    def _plane(self, number: int, places: Sequence[Place]) -> MapPlane:
        frames, known = [], [self._known(place) for place in places]
        for place, one in zip(places, known, strict=True):
            plane, common_T_anchor = self.solution.plane(place)
            normal, d = landmark_hesse(plane.transform(gtsam.Pose3(inverse(common_T_anchor))))
            frames.append(settle_frame(self.solution.bases[place.mission].matrix() @ one.plane.frame, normal, d))
        extent = Extent(known[0].seen)
        for frame, one in zip(frames[1:], known[1:], strict=True):
            extent.grow(flatten(one.seen, inverse(frames[0]) @ frame))
        covariance = self._posteriors[places[0].mission].plane_covariance(places[0].landmark, frames[0])
        n_points = sum(one.plane.n_points for one in known)
        outline = largest_polygon(extent.geometry)
        plane = Plane(frames[0], 0.5 * (covariance + covariance.T), n_points, outline)
        kinds = tuple(sorted({kind for one in known for kind in one.kinds}))
        return MapPlane(number, plane, extent.geometry, sum(one.observations for one in known), kinds)

    def _known(self, place: Place) -> MapPlane:
        return next(plane for plane in self.missions[place.mission].mission.planes if plane.id == place.landmark)


@dataclass(frozen=True, eq=False)
class JoinedMap:
    """What `join` makes of finished missions."""

    components: tuple[JoinedComponent, ...]
    """Missions that overlap, the largest component first."""
    comparisons: tuple[Comparison, ...]
    """Every pair of missions compared, and what came of it."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Missions that could not be used, and why."""
    folders: Mapping[str, str] = field(default_factory=dict)
    """Where the runs of the missions are, as far as they came from folders."""

    @property
    def planes(self) -> list[MapPlane]:
        """The map of the largest component."""
        return self.components[0].planes

    @property
    def trajectories(self) -> dict[str, Trajectory]:
        """Trajectories of the largest component, by mission, in its frame."""
        return self.components[0].trajectories

    @property
    def alone(self) -> list[str]:
        """Missions that overlap with nothing."""
        return [component.names[0] for component in self.components if len(component.missions) == 1]

    def to_dict(self) -> dict[str, Any]:
        """For joins.json."""
        return {
            "format": "spplanes-joins/1",
            "components": [
                {
                    "missions": list(component.names),
                    "common_T_mission": {name: pose.tolist() for name, pose in component.common_T_mission.items()},
                    "planes": {str(number): seen for number, seen in component.seen_by.items()},
                }
                for component in self.components
            ],
            "pairs": [comparison.to_dict() for comparison in self.comparisons],
            "left_out": dict(self.left_out),
            "runs": dict(self.folders),
        }
