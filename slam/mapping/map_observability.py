"""Observability of the map as a whole: motions of every keyframe against the first that planes leave open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from factors.association.observations import LineObservation
from slam.backend.estimator import Backend, pose_symbols
from slam.config import BOUND_SIGMAS, ObservabilityConfig
from slam.frontend.keyframes import Keyframe
from slam.map.landmarks import Landmark, LandmarkMap
from slam.mapping.observability import NOTHING, OpenStretch, gathered, wide_directions
from spplanes._check import FloatArray
from spplanes._hesse import frame_from_hesse

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
    rows = {keyframe: row for row, keyframe in enumerate(held)}
    of_poses = np.arange(6 * len(held)).reshape(-1, 6)
    told = [(of_poses[:1], np.eye(6)[None] / _FIXED**2), (of_poses, np.tile(NOTHING, (len(held), 1, 1)))]
    seen = [_Sightings.of(landmark, keyframes) for landmark in landmarks]
    normals = _settled_normals(landmarks, seen)
    for number, (landmark, sightings, normal) in enumerate(zip(landmarks, seen, normals, strict=True)):
        of_plane = of_poses.size + 3 * number + np.arange(3)
        known = np.eye(3) / _FIXED**2 if landmark.known else np.diag([1e-6, 1e-3, 1e-3])
        told.append((of_plane[None], known[None]))
        if sightings.keyframes:
            poses = backend.poses(pose_symbols(sightings.keyframes))
            jacobians = _derivatives(sightings, poses, normal, landmarks.placed(landmark.id).world_T_plane[:3, 3])
            of_both = of_poses[[rows[one] for one in sightings.keyframes]], np.tile(of_plane, (len(poses), 1))
            told.append((np.hstack(of_both), jacobians.transpose(0, 2, 1) @ jacobians))
    # two dozen, evenly over the run: to each belong six columns of the inverse
    looked_at = sorted({*np.linspace(1, len(held) - 1, min(24, len(held) - 1)).round().astype(int).tolist()})
    found = _covariances(told, of_poses.size + 3 * len(landmarks), of_poses[looked_at])
    open_ones = [
        direction
        for row, covariance in zip(looked_at, found, strict=True)
        for direction in wide_directions(held[row], covariance, np.eye(3), rules)
    ]
    stretches = []
    for group in gathered(open_ones):
        widest, opened = max(group, key=lambda one: one.sigma_seen), tuple(sorted({one.keyframe for one in group}))
        stretches.append(OpenStretch(widest.part, widest.direction, opened, len(looked_at), widest.sigma_seen))
    return stretches


def _covariances(told: Sequence[tuple[np.ndarray, FloatArray]], size: int, wanted: np.ndarray) -> list[FloatArray]:
    """Covariances (6, 6) of variables in some rows (N, 6) of normal equations.

    They are the sum of blocks (K, m, m), those of one kind together, each in its rows (K, m).
    """
    i = np.concatenate([np.repeat(rows, rows.shape[1], axis=1).ravel() for rows, _ in told])
    j = np.concatenate([np.tile(rows, rows.shape[1]).ravel() for rows, _ in told])
    values = np.concatenate([blocks.ravel() for _, blocks in told])
    matrix = coo_matrix((values, (i, j)), shape=(size, size)).tocsc()
    # symmetric and positive: ordered by itself and not by its square, the factors of 1495 poses and 209 planes have
    # 0.1 million entries instead of 3.7
    solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    found = []
    for rows in wanted:
        columns = np.zeros((size, 6))
        columns[rows, np.arange(6)] = 1.0
        block = solver.solve(columns)[rows]
        found.append(0.5 * (block + block.T))
    return found


class _Sightings(NamedTuple):
    """All that was seen of a landmark by keyframes in the graph."""

    keyframes: list[int]
    """Which saw it, K of them."""
    frames: FloatArray
    """Planes as they were measured, in the bodies, shape (K, 4, 4)."""
    covariances: FloatArray
    """Of these, shape (K, 3, 3)."""
    are_lines: np.ndarray
    """Which say nothing on the tilt about themselves, shape (K,)."""

    @classmethod
    def of(cls, landmark: Landmark, keyframes: Sequence[Keyframe]) -> _Sightings:
        """Of one landmark."""
        seen = [keyframes[one.keyframe].observations[one.observation] for one in landmark.sightings]
        planes = [one.full_plane(1.0) for one in seen]
        return cls(
            [one.keyframe for one in landmark.sightings],
            np.array([plane.frame for plane in planes]).reshape(-1, 4, 4),
            np.array([plane.covariance for plane in planes]).reshape(-1, 3, 3),
            np.array([isinstance(one, LineObservation) for one in seen], dtype=bool),
        )

    @property
    def tilt_sigma(self) -> float:
        """How well the firmest of them knows the normal, rad; a plane of a prior map that was not seen is known."""
        least = np.linalg.eigvalsh(self.covariances[:, 1:, 1:])[:, 0]
        return float(np.sqrt(least.min())) if len(least) else 0.0


def _derivatives(seen: _Sightings, world_T_body: FloatArray, normal: FloatArray, origin: FloatArray) -> FloatArray:
    """Whitened derivatives of what poses (K, 4, 4) measured of a plane by pose and plane, shape (K, 3, 9).

    The pose turns by w about itself and moves by t, in world axes: (w, t). The plane, with this normal through this
    origin, moves along the normal and tilts along two axes of its own. A line says nothing on the tilt about itself.
    """
    frames = world_T_body @ seen.frames
    x_axes = frames[:, :3, 0] - np.outer(frames[:, :3, 0] @ normal, normal)
    x_axes /= np.linalg.norm(x_axes, axis=1, keepdims=True)
    y_axes = np.cross(normal, x_axes)
    arms, out = frames[:, :3, 3] - world_T_body[:, :3, 3], frames[:, :3, 3] - origin
    own_axes = frame_from_hesse(normal, 0.0, None)[:3, :2]
    jacobians = np.zeros((len(frames), 3, 9))
    jacobians[:, 0, :3], jacobians[:, 0, 3:6] = np.cross(arms, normal), normal
    jacobians[:, 1, :3], jacobians[:, 2, :3] = y_axes, x_axes
    # a plane whose normal turns by a u + b v falls by that much there
    jacobians[:, 0, 6], jacobians[:, 0, 7:] = -1.0, out @ own_axes
    jacobians[:, 1, 7:], jacobians[:, 2, 7:] = -(x_axes @ own_axes), y_axes @ own_axes
    whitened = np.asarray(np.linalg.solve(np.linalg.cholesky(seen.covariances), jacobians), float)
    whitened[seen.are_lines, 2] = 0.0
    return whitened


def _settled_normals(landmarks: LandmarkMap, seen: Sequence[_Sightings]) -> list[FloatArray]:
    """The landmarks' normals in the world, those that are parallel as far as is known made parallel."""
    normals, sigmas = [landmarks.placed(one.id).normal for one in landmarks], [one.tilt_sigma for one in seen]
    axes: list[tuple[FloatArray, float]] = []
    for row in sorted(range(len(normals)), key=lambda row: sigmas[row]):  # of equals the older
        for axis, sigma in axes:
            if np.linalg.norm(np.cross(axis, normals[row])) <= BOUND_SIGMAS * np.hypot(sigma, sigmas[row]):
                normals[row] = axis if axis @ normals[row] > 0.0 else -axis
                break
        else:
            axes.append((normals[row], sigmas[row]))
    return normals
