"""The shared state: what the steps of an estimator work on together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.frontend.keyframes import Keyframe
from slam.map.landmarks import LandmarkMap
from slam.map.sparsification import Sparsifier


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """The parts that every step reads or changes."""

    keyframes: Sequence[Keyframe]
    """What was measured, in order of time; it grows while the run lasts."""
    landmarks: LandmarkMap
    backend: Backend
    sparsifier: Sparsifier
    config: SlamConfig
