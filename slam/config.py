"""Every number a run depends on, with unit and reason; unknown keys are refused."""

from __future__ import annotations

from typing import Final, Literal

import yaml
from pydantic import ConfigDict, Field

from factors.association.decisions import AssociationGates
from slam._yaml import Frozen
from spplanes import LineConfig, MapperConfig
from spplanes.segmentation.config import ValidationConfig

#: Bounds that are drawn from a standard deviation, within which a test then decides, are taken at this many of them.
BOUND_SIGMAS: Final = 3.0

RobustKernel = Literal["huber", "cauchy", "geman-mcclure", "dcs"]


class _Frozen(Frozen):
    model_config = ConfigDict(allow_inf_nan=False)


class KeyframeConfig(_Frozen):
    """When a keyframe is made."""

    distance_m: float = Field(default=0.5, gt=0)
    """Travel since the last keyframe, m: short enough that odometry inside a window stays below the sensor noise."""
    angle_rad: float = Field(default=0.35, gt=0)
    """Turn since the last keyframe, rad."""
    strict: bool = False
    """Whether a scan that cannot be used ends the run; else it is left out, and counted."""


class LandmarkConfig(_Frozen):
    """Which measurements may start a landmark, and when it counts."""

    min_points: int = Field(default=30, ge=3)
    """Points of a plane that starts a landmark: below, planes are mostly clutter."""
    min_area_m2: float = Field(default=0.2, ge=0)
    """Area of a plane that starts a landmark, m^2: the edge of a notice-board that a window cut is not the board.
    Half of it will do for 200 points that tell the tilt to a fifth of `max_tilt_sigma_rad`: the front of a lamp."""
    max_tilt_sigma_rad: float = Field(default=0.1, gt=0)
    """Standard deviation of tilt, rad, above which a plane does not start a landmark: it could be anything."""
    min_line_points: int = Field(default=12, ge=3)
    """Beams of a line that starts a landmark."""
    min_line_length_m: float = Field(default=0.5, ge=0)
    """Length of a line that starts a landmark, m."""
    min_observations: int = Field(default=2, ge=1)
    """Keyframes that must have seen a landmark before it is part of the map handed out."""
    anchor_every: int = Field(default=10, ge=1)
    """Every so many keyframes' pose is an anchor, and landmarks born until the next live in its frame: few anchors
    keep joint covariances small, near ones keep them well conditioned."""
    waiting_keyframes: int = Field(default=10, ge=0)
    """Keyframes for which planes too uncertain in tilt to start a landmark wait for one born later; 0: they do not."""
    wall_tilt_sigma_rad: float = Field(default=0.01, gt=0)
    """How far walls seen only by one 2D laser may lean from its scan plane's normal, rad."""


class LoopConfig(_Frozen):
    """When and where loops are looked for."""

    every_m: float = Field(default=1.0, gt=0)
    """Travel between two looks, m."""
    window_m: float = Field(default=6.0, gt=0)
    """Landmarks seen within this much travel of a keyframe are its surroundings, m: odometry and lines keep their
    places relative to it good; loops shorter than three windows are left to association."""
    min_walls: int = Field(default=4, ge=4)
    """Fewest walls of surroundings that are compared; two that share as many landmarks are closed already."""
    drift_share: float = Field(default=0.03, ge=0)
    """The search reaches this share of the way between two keyframes beyond three sigma of the state."""
    max_candidates: int = Field(default=4, ge=0)
    """Old keyframes compared with at each look; 0: no loops are looked for."""
    tied_m: float = Field(default=0.3, gt=0)
    """Places whose distance is known better than this, at three sigma, and that share walls are one already, m."""
    look_m: float = Field(default=0.5, gt=0)
    """Length of wall whose returns count as one independent look when two views are compared return by return, m."""
    looks_per_place: float = Field(default=9.0, ge=1)
    """Looks that make one independent witness of *which* place it is: 4.5 m of wall. Buildings repeat walls, doors and
    corners, so submaps of places that are not one agree by whole walls. Measured on ACES: of two such places the best
    match is better than the next by 9 nats on average, each half metre a look, as chance has it."""
    significance: float = Field(default=1e-3, gt=0, lt=0.5)
    """Probability that a loop is closed where there is none, or elsewhere."""


class CoastingConfig(_Frozen):
    """How far motion that nobody measured may differ from the motion before: wide, for the planes are to say it, and
    clouds that tell no time are taken as 1 s apart."""

    speed_sigma_m_per_s: float = Field(default=2.0, gt=0)
    """Of the speed, as long as no motion before is known, or when it is forgotten, m/s."""
    turn_sigma_rad_per_s: float = Field(default=1.4, gt=0)
    """Of the rate of turn, as long as no motion before is known, or when it is forgotten, rad/s."""
    acceleration_sigma_m_per_s2: float = Field(default=2.0, gt=0)
    """Of the change of speed, m/s^2: somebody who carries the sensor starts and stops within a second or two."""
    turn_change_sigma_rad_per_s2: float = Field(default=1.4, gt=0)
    """Of the change of the rate of turn, rad/s^2."""
    robust: RobustKernel | None = "cauchy"
    """Robust kernel on what is matched at a place that the planes had to find: some of it will be wrong."""
    floor_m: float = Field(default=0.01, gt=0)
    """Least standard deviation of a step, m; below what `acceleration_sigma_m_per_s2` says of steps of 0.1 s, or the
    speed of a camera would walk away along what its images leave open."""
    floor_rad: float = Field(default=0.03, gt=0)
    """Least standard deviation of a turn, rad: hands shake."""

    def unknown_motion(self, seconds: float) -> tuple[float, float]:
        """Standard deviations of how far a body goes and turns in so long, of whose motion nothing is known, m, rad."""
        return self.speed_sigma_m_per_s * seconds, self.turn_sigma_rad_per_s * seconds


class ObservabilityConfig(_Frozen):
    """When a direction of motion counts as open: not fixed by anything that was seen."""

    max_sigma_m: float = Field(default=0.15, gt=0)
    """Standard deviation of the position that the planes of one keyframe alone may leave, m."""
    max_sigma_rad: float = Field(default=0.05, gt=0)
    """The same of the orientation, rad."""


class ThinningConfig(_Frozen):
    """Which keyframes leave the graph again, so that it grows with the area mapped, not with the length of the run."""

    passes: int = Field(default=3, ge=0)
    """Earlier passes through a place, in about the same direction, that make it known; 0: every keyframe stays."""
    radius_m: float = Field(default=1.0, gt=0)
    """Keyframes within this distance are of one place, m."""
    angle_rad: float = Field(default=0.5, gt=0)
    """And turned by less than this from each other, rad."""
    apart: int = Field(default=20, gt=0)
    """Keyframes between two of them that make them two passes."""
    max_news: float = Field(default=0.05, ge=0)
    """A keyframe that tells more of the landmarks stays, nats per degree of freedom: another one like ten before."""


class BackendConfig(_Frozen):
    """iSAM2 and its priors."""

    relinearize_threshold: float = Field(default=3e-3, gt=0)
    """Change of a variable that makes iSAM2 relinearise it, rad or m. At 0.01 the end of a run of three scans of a
    corridor was 0.04 sigma from the optimum of its graph; a third of this takes a sixth more of the time of Intel."""
    relinearize_tilt_rad: float = Field(default=3e-4, gt=0)
    """The same of a plane's normal, rad: linearised at one that is off, parallel planes fix what they leave open."""
    robust: RobustKernel | None = None
    """Robust kernel on plane and line factors. None: "dcs" made maps of an office with misread boards honester, but is
    not convex; corridors came out 12 mm too low with it."""
    robust_loops: RobustKernel | None = "huber"
    """Robust kernel on the factors that a loop closure re-keys; None: as on the others. Four sightings of a wall
    forced onto another moved a drive round a room by 101 mm without, by 5.7 mm with kernels on all factors (5.1 mm is
    its error without the closure; medians of 12), and the mean NEES of honest drives from 3.2 to 3.1."""
    prior_sigma_m: float = Field(default=1e-4, gt=0)
    """Sigma of the first pose's position, m: it defines the world, so it is nearly exact."""
    prior_sigma_rad: float = Field(default=1e-5, gt=0)
    """Sigma of the first pose's orientation, rad."""


class SlamConfig(_Frozen):
    """Configuration of a run."""

    model_config = ConfigDict(allow_inf_nan=True)  # no limit to a line's range is one; the parts check their own

    keyframes: KeyframeConfig = KeyframeConfig()
    measurements: ValidationConfig = ValidationConfig()
    association: AssociationGates = AssociationGates()
    landmarks: LandmarkConfig = LandmarkConfig()
    loops: LoopConfig = LoopConfig()
    coasting: CoastingConfig = CoastingConfig()
    observability: ObservabilityConfig = ObservabilityConfig()
    thinning: ThinningConfig = ThinningConfig()
    backend: BackendConfig = BackendConfig()
    mapper: MapperConfig = MapperConfig()
    lines: LineConfig = LineConfig()

    def to_yaml(self) -> str:
        """The configuration as YAML, every field written out."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)
