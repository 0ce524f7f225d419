"""What is expected of a motion that nobody measured: constant velocity, kept as steadily as this body has kept it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam.frontend.odometry import Motion
from slam.frontend.steadiness import Steadiness, Usual
from spplanes._check import FloatArray

#: An axis along which the variance of a step is less than this share of what was expected tells how the body moves.
_TOLD = 0.9


class MotionPrior(NamedTuple):
    """What is expected of one motion; deviations are in SP order along the axes of its end.

    Along each axis velocity changes as it did of late, or, rarely, as any body's may.
    """

    motion: Motion
    """By constant velocity, as wide as if the body might always change it so."""
    change: FloatArray
    """Variances of such a change, shape (6,); the rest of that covariance is of the velocity."""
    usual: Usual
    """How this body changes it."""
    adrift: FloatArray
    """Variances of where it starts from where something was seen last, shape (6,): past a stretch of nothing a body is
    off by all of the way there, and not by its last motion alone."""

    def log_density(self, off: FloatArray, place: FloatArray | None = None) -> FloatArray:
        """Of a deviation (6,), seen with a covariance (6, 6), along each axis, up to the normal's constant, (6,)."""
        return np.logaddexp(*self.usual.log_densities(off, self.change, self._known(place)))

    def log_likelihood(self, off: FloatArray) -> float:
        """Of a deviation (6,), 0 of none."""
        return float(np.sum(self.log_density(off) - self.log_density(np.zeros(6))))

    def learnt(self, off: FloatArray | None = None, place: FloatArray | None = None) -> Motion:
        """The motion, as wide as this body moves, but for the least of a step: it keeps on changing its velocity alike.

        Args:
            off: how far off a scan found the body, shape (6,): what it saw tells whether this is one of the rare
                steps. None: nobody looked.
            place: covariance of that, shape (6, 6).
        """
        usual = self.usual if off is None else self.usual.seen(off, self.change, self._known(place))
        floor_m, floor_rad, _ = self.motion.out_of_plane_sigmas
        less = usual.less(self.change, np.repeat([floor_m, floor_rad], 3) ** 2)
        return replace(self.motion, covariance=self.motion.covariance - np.diag(less))

    @property
    def before(self) -> FloatArray:
        """Variances of the velocity, shape (6,)."""
        return np.diag(self.motion.covariance) - self.change

    def _known(self, place: FloatArray | None) -> FloatArray:
        """Variances of what else makes a step differ, shape (6,)."""
        return self.before + self.adrift + (0.0 if place is None else np.diag(place))


class VelocityPrior:
    """How steadily a body keeps its velocity, along each axis, by its last steps: of 3D scans, a keyframe a step."""

    def __init__(self) -> None:
        self._steadiness = Steadiness(6)

    def prior(self, motion: Motion, change: FloatArray, adrift: FloatArray) -> MotionPrior:
        """Of the next motion, by constant velocity; `change` and `adrift` as of `MotionPrior`, shape (6,) each."""
        return MotionPrior(motion, change, self._steadiness.usual(), adrift)

    def learn(
        self, prior: MotionPrior, off: FloatArray, used: Motion | None = None, known: FloatArray | None = None
    ) -> None:
        """Take in how far off a step turned out to be, SP order along the axes of its end, shape (6,).

        Args:
            prior: what was expected of it.
            off: where the body turned out to be.
            used: what the estimate holds of it, None: nothing. Where nothing was seen the body is where it was
                expected, which says nothing of how it moves. Elsewhere an estimate is drawn to what was expected about
                as much as it errs: it is taken as it is.
            known: covariance of the estimate, shape (6, 6); None: it is known.
        """
        told = np.ones(6, dtype=bool)
        if used is not None and known is not None:
            told = np.diag(known) <= _TOLD * np.diag(used.covariance)
        self._steadiness.learn(off, prior.change, prior.before, told)
