"""What the segmentation may be told; everything else follows from the noise of the points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

#: Grids with fewer rows hold strips of planes rather than planes.
FEW_ROWS = 16


@dataclass(frozen=True)
class MapperConfig:
    """Settings of `segment_scans` and `PlaneMapper`: one default for every sensor, because the noise is an input."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    significance: float = 0.001
    """Share of true merges that a chi2 test may refuse; in (0, 0.5)."""
    flatness_m: float = 0.0025
    """How far a surface that counts as a plane may deviate from one, m: plaster, cushions, quantised depth.

    It loosens every test (as noise of each point and as a bias that more points do not average away), never the
    covariance of the planes."""
    surface_sigma_m: float = 0.0
    """Least standard deviation of an octave of the error that neighbouring points share, m: flatness of real walls,
    range bias. What residuals show beyond it is found and added (`spplanes.fitting.shared_error`); state more where a
    cloud cannot show it, as of a bias that all points of a plane have."""
    max_incidence_rad: float = 1.48
    """Steepest incidence at which a surface is still expected, rad (85 deg): larger steps in depth are jumps."""
    literal_edge_test: bool = False
    """Use the paper's edge test, which takes the sampling distance for error, in place of the jump in depth."""
    edge_significance: float = 0.001
    """Share of true edges that the chi2 test of the quad filter may refuse; in (0, 0.5)."""
    gate_sigma: float = 3.5
    """A single point belongs to a plane within this many standard deviations."""
    max_tilt_rad: float = 0.1
    """Standard deviation of tilt, rad, above which a patch does not determine a plane of its own."""
    max_crease_rad: float = 0.26
    """Turn of the surface against its plane, rad (15 deg), at which a region ends even though the points stay on the
    plane: a seam between cushions. It is only judged where noise leaves a local normal."""
    min_points: int = 60
    """Fewest points of a plane that is reported."""
    largest_cell: int = 32
    """Side of the cells the search in an organised grid starts with, points; a power of two times `smallest_cell`."""
    smallest_cell: int = 4
    """Side of the cells it ends with, points."""
    border_smoothness: float = 1.5
    """Weight of an unlike neighbour, in chi2, when points at the border of two regions choose theirs."""
    outline_cell_m: float = 0.05
    """Resolution of outlines, m: holes and notches below it are closed."""

    pose_correlation_scans: float = 0.0
    """Number of scans over which the correlation of their pose errors falls to 1/e; 0: each scan errs on its own.

    A robot that is localised while it drives errs alike over metres: then a plane seen in many scans knows less than
    their number promises."""
    strip_scans: int = 64
    """Scans that `PlaneMapper` settles at a time; at least 2, the paper's."""
    lookahead_scans: int = 16
    """Scans that `PlaneMapper` sees beyond those it settles."""
    keep_labels: bool = False
    """Whether `PlaneMapper` keeps the plane of every point, 4 bytes each; by default memory grows with planes only."""

    def __post_init__(self) -> None:
        for name in ("significance", "edge_significance"):
            check_range(name, getattr(self, name), 0.0, 0.5)
        for name in ("gate_sigma", "outline_cell_m", "max_tilt_rad", "max_crease_rad"):
            check_range(name, getattr(self, name), 0.0, np.inf)
        check_range("max_incidence_rad", self.max_incidence_rad, 0.0, np.pi / 2)
        for name in ("flatness_m", "surface_sigma_m", "border_smoothness", "pose_correlation_scans"):
            check_range(name, getattr(self, name), 0.0, np.inf, closed=True)
        fewest = {"min_points": 3, "largest_cell": 3, "smallest_cell": 3, "strip_scans": 2, "lookahead_scans": 0}
        for name, least in fewest.items():
            if int(getattr(self, name)) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        if self.largest_cell < self.smallest_cell:
            raise ValueError(f"largest_cell: expected at least smallest_cell, got {self.largest_cell}")

    @property
    def pose_decay(self) -> float:
        """Correlation of the pose errors of successive scans."""
        return float(np.exp(-1.0 / self.pose_correlation_scans)) if self.pose_correlation_scans > 0.0 else 0.0

    def for_rows(self, n_rows: int) -> MapperConfig:
        """The settings for a grid of so few rows: what it can show of a plane is a strip.

        The points of a strip, eight at least, go with its rows, what it tells of its tilt with their power of 1.5.
        """
        if n_rows >= FEW_ROWS:
            return self
        share = max(n_rows, 1) / FEW_ROWS
        fewest = max(min(8, self.min_points), round(self.min_points * share))
        return replace(self, min_points=fewest, max_tilt_rad=self.max_tilt_rad / share**1.5)


@dataclass(frozen=True)
class ValidationConfig:
    """Which fitted planes are believed to be one plane, seen properly."""

    misfit_sigmas: float = 3.0
    """A fit's chi2 may exceed its mean by this many standard deviations; beyond, two surfaces were taken for one."""
    noise_slack: float = 0.05
    """Share by which the true noise variance may exceed the stated one without that counting as misfit."""
    step_m: float = 0.003
    """Mean residual of a patch or strip below which a plane is uneven but not two, m: plaster, not notice-boards."""
    step_sigmas: float = 4.0
    """The mean residual of a patch or strip lies within this many of its standard deviations, or it is a step."""
    patch_m: float = 0.25
    """Side of the patches, and width of the strips, whose mean residuals are looked at, m."""
    max_incidence_rad: float = 1.5
    """A plane seen more edge-on than this from the middle of its points is an artefact of one scan line, rad."""

    def __post_init__(self) -> None:
        for name in ("misfit_sigmas", "step_sigmas", "patch_m"):
            check_range(name, getattr(self, name), 0.0, np.inf)
        for name in ("noise_slack", "step_m"):
            check_range(name, getattr(self, name), 0.0, np.inf, closed=True)
        check_range("max_incidence_rad", self.max_incidence_rad, 0.0, np.pi / 2)


def check_range(name: str, value: float, low: float, high: float, *, closed: bool = False) -> None:
    """Raise unless value lies in (low, high), or in [low, high) when closed."""
    inside = np.isfinite(value) and value < high and (value > low or (closed and value == low))
    if not inside:
        raise ValueError(f"{name}: expected a number in {'[' if closed else '('}{low}, {high}), got {value}")
