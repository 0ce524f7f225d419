"""The record of fusions: which landmark became part of which, when, why, and whether it was undone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from slam.map.landmarks import Landmark

Cause = Literal["same plane", "loop"]


@dataclass(eq=False)
class Merge:
    """Two landmarks that were taken for one."""

    keyframe: int
    """When: index of the keyframe."""
    older: int
    """Id of the landmark that took everything."""
    younger: int
    """Id of the one that is gone."""
    cause: Cause
    """twins: their difference passed its chi2; loop: a closure paired them."""
    gone: Landmark
    """The younger as it was."""
    undone: int | None = None
    """The keyframe at which the merge was found wrong; None: it stands."""
    next_look: int = 0
    """Keyframe from which on its residuals are looked at again."""
