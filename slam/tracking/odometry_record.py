"""What 3D scans have said of the odometry so far, and by how much it errs where they can say nothing."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import expit, logit

from slam.frontend.odometry import Motion
from slam.frontend.steadiness import LATE
from slam.registration.relocalization import displacement
from slam.tracking.odometry_check import Check
from spplanes._check import FloatArray

#: Share of the steps after one in which wheels slip that slip as well: they do so for a while.
_AGAIN = 0.5


class CheckedStep(NamedTuple):
    """A step of the odometry that a 3D scan was held against."""

    keyframe: int
    """Where it ends."""
    motion: Motion
    """As it was measured, as wide as it was taken to be."""
    check: Check
    """What the scan said."""
    used: Literal["as stated", "erring", "not"]
    """What became of it: used as it was stated, as far off as others were, or not, for an assumption was nearer."""
    scale: float = 1.0
    """Times its stated sigma that `motion` has; see `slam.tracking.odometry_scale`."""


class OdometryRecord:
    """The steps of the odometry that were checked, and how far off those spoken against turned out to be.

    A corridor does not make wheels right that stood still in front of it. Where a scan would not have told errors such
    as those before, they are to be expected as often as they were found where scans did tell.
    """

    def __init__(self, significance: float) -> None:
        """With the probability that a true motion is spoken against."""
        self.significance = significance
        self.steps: list[CheckedStep] = []
        #: How far off steps spoken against were, and what was expected instead of them; and of the others, with what
        #: was said of them, how far off that would have been.
        self._errors: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=LATE)
        self._others: deque[tuple[CheckedStep, FloatArray]] = deque(maxlen=LATE)
        self._last: tuple[CheckedStep, Motion] | None = None
        #: Probability that wheels slipped in the last step, as they had begun to before or in it.
        self._slipped = 0.0

    @property
    def again(self) -> float:
        """Probability that wheels slip in the next step as they did in the last."""
        return _AGAIN * self._slipped

    @property
    def errors(self) -> FloatArray:
        """What the last steps spoken against were off, SP order along the axes of their ends, shape (K, 6)."""
        return np.array([one for one, _ in self._errors]).reshape(-1, 6)

    def settle(self, a_T_b: FloatArray) -> None:
        """Take in where the last step led, shape (4, 4), now that it was seen."""
        if self._last is None:
            return
        step, expected = self._last
        off = displacement(expected.a_T_b, a_T_b)
        if step.check.against:
            self._errors.append((displacement(step.motion.a_T_b, a_T_b), off))
        else:
            self._others.append((step, off))
        self._last = None

    def take(
        self, keyframe: int, motion: Motion, expected: Motion, guess: Motion, check: Check, scale: float = 1.0
    ) -> Motion:
        """What is known of a step by odometry and the check of it.

        Args:
            keyframe: where it ends.
            motion: as it was measured.
            expected: the motion had nobody measured it.
            guess: how far a body may move of which nothing is known.
            check: what a 3D scan says of it.
            scale: times its stated sigma that the motion has.
        """
        untold = self.untold(motion, check)
        self._slipped = self._goes_on(check, len(untold))
        if check.against:
            used, known = "not", expected if self._is_nearer() else replace(guess, a_T_b=motion.a_T_b)
        elif not len(untold):
            used, known = "as stated", motion
        else:
            fine = self._fine()
            slips = 1.0 - (1.0 - self._slipped) * len(fine) / (len(self._errors) + len(fine))
            used, known = "not", expected
            if not self._is_nearer(slips, fine):
                used, known = "erring", motion.erring(slips * untold.T @ untold / len(self._errors))
        self.steps.append(CheckedStep(keyframe, motion, check, used, scale))
        self._last = self.steps[-1], expected
        return known

    def untold(self, motion: Motion, check: Check) -> FloatArray:
        """Those of the errors that a check would not have told, shape (K, 6)."""
        errors = self.errors
        return errors[~check.tells(motion, errors, self.significance)]

    def believed(self) -> list[tuple[int, FloatArray]]:
        """Steps used as stated, by their keyframes, with the errors found since that their scans left untold."""
        stated = [
            (step.keyframe, self.untold(step.motion, step.check)) for step in self.steps if step.used == "as stated"
        ]
        return [(keyframe, errors) for keyframe, errors in stated if len(errors)]

    def _fine(self) -> list[FloatArray]:
        """How far off what was expected was in the last steps not spoken against, where most errors would have been."""
        errors = self.errors
        told = (step.check.tells(step.motion, errors, self.significance).mean() for step, _ in self._others)
        return [off for (_, off), share in zip(self._others, told, strict=True) if share > 0.5]

    def _goes_on(self, check: Check, untold: int) -> float:
        """Probability that wheels slip on, by what a check says that would have left so many of the errors untold."""
        if check.against:
            return 1.0
        if check.odds is not None:
            return float(expit(logit(self.again) + check.odds))
        left = self.again * untold / max(len(self._errors), 1)
        return left / (left + 1.0 - self.again)

    def _is_nearer(self, slips: float = 1.0, fine: Sequence[FloatArray] = ()) -> bool:
        """Whether what would be expected without them is nearer than steps of which such a share slips.

        Mean squares, of m and of rad at a metre.
        """
        measured, expected = (np.mean([error[k] @ error[k] for error in self._errors] or [0.0]) for k in (0, 1))
        other = np.mean([off @ off for off in fine] or [0.0])
        return bool(slips * expected + (1.0 - slips) * other < slips * measured)
