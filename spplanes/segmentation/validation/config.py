"""Which fitted planes are believed to be one plane, seen properly: the settings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spplanes.segmentation.config import check_range


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
