"""What evidence is drawn from: the parts of an estimator whose run has ended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.diagnostics.consistency import NisAudit
from slam.diagnostics.observability import OpenStretch
from slam.frontend.keyframes import Keyframe
from slam.frontend.wheel_calibration import WheelCalibration
from slam.io.trajectories import Trajectory
from slam.loop_closure.verification import LoopDecision
from slam.map.data_association import Decision
from slam.map.landmarks import LandmarkMap
from slam.mapping.map_update import LateMatch
from slam.registration.relocalization import Rivals
from slam.session.prior_map import PriorMap
from slam.tracking.odometry_record import OdometryRecord


class Finished(Protocol):
    """An estimator at the end of its run, read only."""

    @property
    def config(self) -> SlamConfig:
        """The settings."""

    @property
    def backend(self) -> Backend:
        """The graph."""

    @property
    def landmarks(self) -> LandmarkMap:
        """The map, confirmed or not."""

    @property
    def audit(self) -> NisAudit:
        """Chi2 of what was accepted."""

    @property
    def prior(self) -> PriorMap | None:
        """What was known beforehand."""

    @property
    def keyframes(self) -> Sequence[Keyframe]:
        """What was measured."""

    @property
    def decisions(self) -> Sequence[list[Decision]]:
        """What became of every observation, by keyframe."""

    @property
    def late_matches(self) -> list[LateMatch]:
        """Observations matched after their own keyframe."""

    @property
    def open_in_map(self) -> list[OpenStretch]:
        """Directions in which all planes together do not fix the keyframes against the first."""

    @property
    def calibration(self) -> WheelCalibration:
        """What was learnt of the wheels."""

    @property
    def odometry_record(self) -> OdometryRecord:
        """What 3D scans said of the odometry."""

    @property
    def unplaced(self) -> list[int]:
        """Keyframes with a 3D scan that fits nowhere, though little was known of the motion to them."""

    @property
    def loops(self) -> list[LoopDecision]:
        """What became of every loop that was looked for."""

    @property
    def rivals(self) -> dict[int, Rivals]:
        """Of every keyframe placed by what it saw alone, the other places that this fits."""

    @property
    def trajectory(self) -> Trajectory:
        """world_T_body of every keyframe."""
