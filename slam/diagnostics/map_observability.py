"""Observability of the map as a whole: motions of every keyframe against the first that planes leave open."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from slam.backend.estimator import Backend, pose_symbol
from slam.config import BOUND_SIGMAS, ObservabilityConfig
from slam.diagnostics.observability import NOTHING, OpenDirection, OpenStretch, gathered, wide_directions
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import LineObservation, Observation
from slam.map.landmarks import Landmark, LandmarkMap
from spplanes._check import FloatArray
from spplanes._hesse import frame_from_hesse

#: Keyframes that are looked at, evenly over the run: to each belong six columns of the inverse.
_MOST = 24
#: Standard deviation of the first keyframe, from which all others are counted, m and rad.
_FIXED = 1e-6


def open_in_map(
    held: Sequence[int],
    keyframes: Sequence[Keyframe],
    landmarks: LandmarkMap,
    backend: Backend,
    rules: ObservabilityConfig,
) -> list[OpenStretch]:
    """Directions that all planes together leave open, odometry and assumptions on motion left out.

    The normal equations of every sighting of the keyframes in the graph (`held`, ascending), in all their poses and all
    landmarks at once, the first keyframe and planes of a prior map fixed. Two ends of a map that only a bare corridor
    links are open against each other, though each keyframe in them is fixed by what it sees. Normals that are parallel
    as far as is known are taken as parallel, else their errors would seem to fix what slides along them.
    """
    if len(held) < 2:
        return []
    rows = {keyframe: 6 * row for row, keyframe in enumerate(held)}
    information = _Information(6 * len(held), len(landmarks))
    information.add(0, np.eye(6) / _FIXED**2)
    for row in rows.values():
        information.add(row, NOTHING)
    for number, (landmark, normal) in enumerate(zip(landmarks, _settled_normals(landmarks, keyframes), strict=True)):
        known = np.eye(3) / _FIXED**2 if landmark.known else np.diag([1e-6, 1e-3, 1e-3])
        information.add(information.landmark(number), known)
        origin = landmarks.placed(landmark.id).world_T_plane[:3, 3]
        for sighting in landmark.sightings:
            seen, pose = (
                keyframes[sighting.keyframe].observations[sighting.observation],
                backend.pose(pose_symbol(sighting.keyframe)),
            )
            by_pose, by_plane = _derivatives(seen, pose, normal, origin)
            information.see(rows[sighting.keyframe], information.landmark(number), by_pose, by_plane)
    looked_at = sorted({*np.linspace(1, len(held) - 1, min(_MOST, len(held) - 1)).round().astype(int).tolist()})
    found = information.covariances([6 * row for row in looked_at])
    open_ones = [
        direction
        for row, covariance in zip(looked_at, found, strict=True)
        for direction in wide_directions(held[row], covariance, np.eye(3), rules)
    ]
    return [_summed_up(group, len(looked_at)) for group in gathered(open_ones)]


def _summed_up(group: Sequence[OpenDirection], looked_at: int) -> OpenStretch:
    widest = max(group, key=lambda one: one.sigma_seen)
    keyframes = tuple(sorted({one.keyframe for one in group}))
    return OpenStretch(widest.part, widest.direction, keyframes, looked_at, widest.sigma_seen)


class _Information:
    """Normal equations over poses, six rows each, and landmarks, three rows each after them."""

    def __init__(self, of_poses: int, landmarks: int) -> None:
        self._of_poses, self._size = of_poses, of_poses + 3 * landmarks
        self._blocks: list[tuple[np.ndarray, np.ndarray, FloatArray]] = []

    def landmark(self, number: int) -> int:
        """First row of a landmark."""
        return self._of_poses + 3 * number

    def add(self, row: int, block: FloatArray) -> None:
        """Information of one variable."""
        places = row + np.arange(len(block))
        self._blocks.append((np.repeat(places, len(block)), np.tile(places, len(block)), block.ravel()))

    def see(self, pose: int, plane: int, by_pose: FloatArray, by_plane: FloatArray) -> None:
        """Information of a measurement whose whitened derivatives these are, (k, 6) and (k, 3)."""
        places = np.concatenate((pose + np.arange(6), plane + np.arange(3)))
        jacobian = np.hstack((by_pose, by_plane))
        block = (jacobian.T @ jacobian).ravel()
        self._blocks.append((np.repeat(places, 9), np.tile(places, 9), block))

    def covariances(self, rows: Sequence[int]) -> list[FloatArray]:
        """Covariances (6, 6) of the variables that begin at these rows."""
        i, j, values = (np.concatenate(part) for part in zip(*self._blocks, strict=True))
        solver = splu(coo_matrix((values, (i, j)), shape=(self._size, self._size)).tocsc())
        found = []
        for row in rows:
            columns = np.zeros((self._size, 6))
            columns[row + np.arange(6), np.arange(6)] = 1.0
            block = solver.solve(columns)[row : row + 6]
            found.append(0.5 * (block + block.T))
        return found


def _derivatives(
    seen: Observation, world_T_body: FloatArray, normal: FloatArray, origin: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened derivatives of what is measured of a plane by the pose (k, 6) and by the plane (k, 3).

    The pose turns by w about itself and moves by t, in world axes: (w, t). The plane, with this normal through this
    origin, moves along the normal and tilts along two axes of its own. A line says nothing on the tilt about itself.
    """
    plane = seen.full_plane(1.0)
    frame = world_T_body @ plane.frame
    x_axis = frame[:3, 0] - normal * (normal @ frame[:3, 0])
    x_axis /= np.linalg.norm(x_axis)
    y_axis = np.cross(normal, x_axis)
    arm, out = frame[:3, 3] - world_T_body[:3, 3], frame[:3, 3] - origin
    u_axis, v_axis = frame_from_hesse(normal, 0.0, None)[:3, :2].T
    by_pose, by_plane = np.zeros((3, 6)), np.zeros((3, 3))
    by_pose[0, :3], by_pose[0, 3:] = np.cross(arm, normal), normal
    by_pose[1, :3], by_pose[2, :3] = y_axis, x_axis
    by_plane[0] = -1.0, u_axis @ out, v_axis @ out  # a plane whose normal turns by a u + b v falls by that much there
    by_plane[1, 1:] = -(x_axis @ u_axis), -(x_axis @ v_axis)
    by_plane[2, 1:] = y_axis @ u_axis, y_axis @ v_axis
    told = 2 if isinstance(seen, LineObservation) else 3
    root = np.linalg.cholesky(plane.covariance[:told, :told])
    both = np.asarray(np.linalg.solve(root, np.hstack((by_pose, by_plane))[:told]), float)
    return both[:, :6], both[:, 6:]


def _settled_normals(landmarks: LandmarkMap, keyframes: Sequence[Keyframe]) -> list[FloatArray]:
    """The landmarks' normals in the world, those that are parallel as far as is known made parallel."""
    axes: list[tuple[FloatArray, float]] = []
    settled: dict[int, FloatArray] = {}
    sigmas = {one.id: _tilt_sigma(one, keyframes) for one in landmarks}
    for key in sorted(sigmas, key=lambda key: (sigmas[key], key)):
        normal = landmarks.placed(key).normal
        for axis, sigma in axes:
            if np.linalg.norm(np.cross(axis, normal)) <= BOUND_SIGMAS * np.hypot(sigma, sigmas[key]):
                settled[key] = axis if axis @ normal > 0.0 else -axis
                break
        else:
            axes.append((normal, sigmas[key]))
            settled[key] = normal
    return [settled[one.id] for one in landmarks]


def _tilt_sigma(landmark: Landmark, keyframes: Sequence[Keyframe]) -> float:
    """How well the firmest sighting of a landmark knows its normal, rad."""
    seen: Iterable[Observation] = (
        keyframes[sighting.keyframe].observations[sighting.observation] for sighting in landmark.sightings
    )
    tilts = (one.full_plane(1.0).covariance[1:, 1:] for one in seen)
    return min((float(np.sqrt(np.linalg.eigvalsh(tilt)[0])) for tilt in tilts), default=0.0)
