"""The frames of a bag: a tree of transforms, and where sensors sit on the body."""

from __future__ import annotations

import numpy as np

from slam.geometry.frames import inverse
from spplanes._check import FloatArray

#: Names that bodies have, the first that is there is taken.
BODIES = ("base_link", "base_footprint", "base", "base_frame", "imu_link", "imu")
#: Frames of the world, which no body has.
WORLDS = ("map", "odom", "world", "earth")


def is_world(frame: str) -> bool:
    """Whether a frame is one of the world: by its name, or by one that begins with odom, such as odom_combined."""
    name = frame.rsplit("/", 1)[-1]
    return name in WORLDS or name.startswith("odom")


#: A transform that changes by more than this moves, m and rad.
_STILL = 1e-6


class Frames:
    """Transforms between frames; those that move are known apart from those that do not."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        self._moving: set[str] = set()

    def add(self, parent: str, child: str, parent_T_child: FloatArray) -> None:
        """A transform as a message tells it."""
        known = self._parents.setdefault(child, (parent, parent_T_child))
        if known[0] != parent or np.abs(known[1] - parent_T_child).max() > _STILL:
            self._moving.add(child)

    def __contains__(self, frame: str) -> bool:
        return frame in self._parents or any(parent == frame for parent, _ in self._parents.values())

    @property
    def names(self) -> str:
        """All frames, for a sentence."""
        return ", ".join(sorted({*self._parents, *(parent for parent, _ in self._parents.values())})) or "none"

    @property
    def moving_roots(self) -> dict[str, str]:
        """Frames that have none above them, with the first of those that move against them."""
        moving = {self._parents[child][0]: child for child in sorted(self._moving, reverse=True)}
        return {parent: child for parent, child in sorted(moving.items()) if parent not in self._parents}

    def body_T(self, body: str, sensor: str) -> FloatArray | None:
        """body_T_sensor (4, 4) by transforms that do not move; None: they do not connect the two."""
        up_from_body, up_from_sensor = self._chain(body), self._chain(sensor)
        common = next((frame for frame in up_from_sensor if frame in up_from_body), None)
        return None if common is None else inverse(up_from_body[common]) @ up_from_sensor[common]

    def _chain(self, frame: str) -> dict[str, FloatArray]:
        """ancestor_T_frame of the frame itself and of all above it that do not move against it."""
        chain, transform = {frame: np.eye(4)}, np.eye(4)
        while frame in self._parents and frame not in self._moving:
            frame, step = self._parents[frame]
            if frame in chain or is_world(frame):
                break
            transform = step @ transform
            chain[frame] = transform
        return chain
