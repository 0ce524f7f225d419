"""Plane-based SLAM: from sensor logs to a map of planes with covariances."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slam.config import SlamConfig
    from slam.frontend.keyframes import Keyframe
    from slam.planeslam import PlaneSlam

__all__ = ["Keyframe", "PlaneSlam", "SlamConfig"]

_HOMES = {"Keyframe": "slam.frontend.keyframes", "PlaneSlam": "slam.planeslam", "SlamConfig": "slam.config"}


def __getattr__(name: str) -> Any:
    # imported when asked for: `spplanes --help` must not wait for gtsam and numba
    if name not in _HOMES:
        raise AttributeError(f"module 'slam' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
