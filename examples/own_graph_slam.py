"""A whole SLAM of one's own on `gtsam.ISAM2`: odometry, planes, laser lines, and the association that `slam` uses.

The front end cuts a log into keyframes: planes and lines in the body frame, and the motion by wheels and successive
scans. Everything behind it is `OwnSlam` below; what it leaves out beside `PlaneSlam` is loop closure, merging, learning
and repair. Without arguments a simulated corridor is driven, with a level and a push-broom laser; with a log and a file
of relations it is a real one:

    python examples/own_graph_slam.py drive.clf.gz drive.relations.gz
"""

from __future__ import annotations

import sys
from pathlib import Path

import gtsam
import numpy as np

from factors import (
    LandmarkExtents,
    LineObservation,
    Prediction,
    associate,
    isam2_parameters,
    observation_factor,
    plane_factor,
    pose_prior,
)
from factors.association.observations import Observation
from slam import SlamConfig
from slam.evaluation.trajectories import absolute_error, read_relations, relation_errors
from slam.frontend.keyframes import Keyframe, keyframes_of
from slam.io.load import load
from slam.io.trajectories import Trajectory
from slam.runs.scan_trajectory import scan_trajectory
from slam.runs.slam_run import odometry_of
from slam.simulation import simulate_mission


class OwnSlam:
    """Poses x0, x1, ... and planes p0, p1, ..., each plane in the frame of the pose before the one that saw it."""

    #: A line shorter than this starts no landmark, m; a plane whose tilt is known worse neither, rad.
    LEAST_M, MOST_RAD = 0.5, 0.02
    #: How far walls that a level laser sees may lean, rad: a line says nothing of it.
    WALL_TILT_RAD = 0.01

    def __init__(self) -> None:
        self.isam, self.landmarks, self.stamps = gtsam.ISAM2(isam2_parameters()), LandmarkExtents(), list[int]()

    def add(self, keyframe: Keyframe) -> None:
        """One keyframe: its pose by the motion, what it sees by association."""
        key = gtsam.symbol("x", len(self.stamps))
        self._predict(keyframe, key)
        prediction = Prediction.of_isam(self.isam, key)
        graph, values, seen = gtsam.NonlinearFactorGraph(), gtsam.Values(), keyframe.observations
        association = associate(seen, prediction, self.landmarks, wall_tilt_sigma_rad=self.WALL_TILT_RAD)
        matches = [(one.plane_key, seen[one.observation]) for one in association.matches if one.plane_key is not None]
        for plane_key, observation in matches:
            graph.push_back(observation_factor(observation, key, self.landmarks[plane_key], prediction))
        for group in association.new_planes:
            if self._is_firm(seen[group[0]]):
                graph.push_back(self._start([seen[member] for member in group], key, prediction, values))
        self.isam.update(graph, values)
        now = self.isam.calculateEstimate()
        for plane_key, observation in matches:
            self.landmarks.see(plane_key, observation, key, now)
        self.stamps.append(keyframe.stamp_ns)

    def _predict(self, keyframe: Keyframe, key: int) -> None:
        graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Pose3()
        motion = keyframe.motion and (keyframe.motion.scan_matched or keyframe.motion)
        if motion is None:  # the first
            graph.push_back(pose_prior(key, np.eye(4), 1e-6 * np.eye(6)))
        else:
            for factor in motion.factors(key - 1, key):
                graph.push_back(factor)
            pose = self.isam.calculateEstimatePose3(key - 1).compose(gtsam.Pose3(motion.a_T_b))
        values.insert(key, pose)
        self.isam.update(graph, values)

    def _is_firm(self, seen: Observation) -> bool:
        if isinstance(seen, LineObservation):
            return float(np.linalg.norm(seen.vertices[1] - seen.vertices[0])) >= self.LEAST_M
        tilt = np.linalg.eigvalsh(seen.full_plane(self.WALL_TILT_RAD).covariance[1:, 1:])[-1]
        return float(np.sqrt(tilt)) <= self.MOST_RAD

    def _start(
        self, seen: list[Observation], key: int, prediction: Prediction, values: gtsam.Values
    ) -> gtsam.NonlinearFactorGraph:
        """A new plane out of all that is seen of it; the first holds it in every direction, a lean as walls have it."""
        plane_key, graph = gtsam.symbol("p", len(self.landmarks)), gtsam.NonlinearFactorGraph()
        anchor = key - 1 if self.stamps else key  # of its own pose a landmark's factor is custom, and slow
        start = self.landmarks.start(plane_key, seen[0], key, prediction.values, anchor_key=anchor)
        values.insert(plane_key, start)
        graph.push_back(plane_factor(seen[0].full_plane(self.WALL_TILT_RAD), key, plane_key, anchor_key=anchor))
        for other in seen[1:]:
            graph.push_back(other.factor(key, plane_key, anchor, None, start))
        return graph

    @property
    def trajectory(self) -> Trajectory:
        """world_T_body of every keyframe."""
        poses = [self.isam.calculateEstimatePose3(gtsam.symbol("x", i)).matrix() for i in range(len(self.stamps))]
        return Trajectory(np.array(self.stamps), np.array(poses))


def main(words: list[str]) -> None:
    """Drive, estimate, compare with odometry alone."""
    config, slam = SlamConfig(), OwnSlam()
    mission = None if words else simulate_mission("corridor", n_scans=400, seed=0)
    log, rig = load(Path(words[0])) if mission is None else (mission.log, mission.rig)
    for keyframe in keyframes_of(log, rig, config):
        slam.add(keyframe)
    print(f"{len(slam.stamps)} keyframes, {len(slam.landmarks)} planes")
    for name, path in (("own graph", slam.trajectory), ("odometry alone", odometry_of(log, rig, slam.trajectory))):
        if mission is None:
            errors = relation_errors(scan_trajectory(path, log, rig, config), read_relations(words[1]))
        else:
            errors = absolute_error(path, mission.truth.trajectory, alignment="first")
        metres, degrees = errors.translation_m.mean(), np.degrees(errors.rotation_rad.mean())
        print(f"{name:15} {1e3 * metres:8.1f} mm {degrees:8.3f} deg in the mean")


if __name__ == "__main__":
    main(sys.argv[1:])
