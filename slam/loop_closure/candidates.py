"""Loop closure: candidates, the old keyframes near enough on the way to be the place of the newest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend, pose_symbol, pose_symbols
from slam.config import BOUND_SIGMAS, LoopConfig
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """The way so far, and where on it the keyframes are that the graph holds."""

    frames: np.ndarray
    """Those keyframes, ascending, shape (M,); the last is the newest of all."""
    poses: FloatArray
    """Their world_T_body by the current estimate, shape (M, 4, 4)."""
    lengths: FloatArray
    """Length of the way to every keyframe, m, shape (N,)."""

    @classmethod
    def of(cls, frames: Sequence[int], driven: FloatArray, backend: Backend) -> DrivenPath:
        """By the backend's estimate; where keyframes have left the graph, by the way as it was driven, (N,) m."""
        held = np.array(frames)
        poses = backend.poses(pose_symbols(frames))
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        steps = np.where(np.diff(held) == 1, steps, np.diff(driven[held]))
        lengths = np.concatenate(([0.0], np.cumsum(steps)))
        rows = np.searchsorted(held, np.arange(len(driven)), side="right") - 1
        return cls(held, poses, lengths[rows] + (driven - driven[held[rows]]))

    def pose(self, frame: int) -> FloatArray:
        """world_T_body of one of those keyframes, shape (4, 4)."""
        return self.poses[np.searchsorted(self.frames, frame)]

    def window(self, frame: int, window_m: float) -> tuple[int, int]:
        """The first and the last of all keyframes within so much travel of one."""
        way = self.lengths[frame]
        first = np.searchsorted(self.lengths, way - window_m, side="left")
        return int(first), int(np.searchsorted(self.lengths, way + window_m, side="right")) - 1


def old_keyframes(path: DrivenPath, backend: Backend, config: LoopConfig) -> list[int]:
    """Keyframes of long ago within the search radius, nearest first, one in each stretch of the way."""
    ways = path.lengths[path.frames]
    since = path.lengths[-1] - ways
    distances = np.linalg.norm(path.poses[:, :3, 3] - path.poses[-1, :3, 3], axis=1)
    reach = config.drift_share * since + config.window_m
    far = 3.0 * config.window_m
    if not np.any(since > far):
        return []
    radius = radius_of(pose_symbol(int(path.frames[-1])), backend) + reach
    wanted = np.flatnonzero((since > far) & (distances <= radius))
    chosen: list[int] = []
    for row in wanted[np.argsort(distances[wanted], kind="stable")].tolist():
        if len(chosen) == config.max_candidates:
            break
        if all(abs(ways[row] - ways[other]) > config.window_m for other in chosen):
            chosen.append(row)
    return path.frames[chosen].tolist()


def radius_of(pose_key: int, backend: Backend) -> float:
    """Three sigma of a pose's position in its least known direction, m."""
    covariance = backend.covariance(pose_key)[3:, 3:]
    return BOUND_SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def nearest_of_each(near: np.ndarray, away: FloatArray, stretch: np.ndarray) -> np.ndarray:
    """Of candidates (N,) near a place the nearest of each stretch of the way, ascending by stretch, shape (M,).

    They are `away` from the place, m, shape (N,), each on the stretch of a number, shape (N,).
    """
    order = np.lexsort((near, away, stretch))
    _, first = np.unique(stretch[order], return_index=True)
    return near[order][first]
