"""Loop closure: every metre or so, is what is seen now a place of long ago? Then their walls are joined."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.backend.estimator import Backend, pose_symbol
from slam.frontend.odometry import Motion
from slam.loop_closure.candidates import DrivenPath
from slam.loop_closure.verification import LoopDecision, disjoint, find_loop
from slam.map.state import Parts
from slam.mapping.fusion import Merges

#: After a tie that is taken back the estimate goes back a long way: so often iSAM2 relinearises.
_ROUNDS = 5


@dataclass(eq=False)
class Tie:
    """The motion that the returns tell between the two ends of a closed loop, in the graph."""

    loop: LoopDecision
    """The loop it comes with."""
    motion: Motion
    """From the old keyframe to the newer one."""
    pairs: tuple[tuple[int, int], ...]
    """The landmarks (older, younger) that were joined with it."""
    factor_index: int
    """Index of its factor."""
    undone: int | None = None
    """The keyframe at which it was found wrong; None: it stands."""

    def misfit(self, backend: Backend) -> float:
        """Chi2 of the motion at the current estimate."""
        factor = _factor(self.loop, self.motion)
        return 2.0 * float(factor.error(backend.values_of(factor.keys())))


class LoopClosing(Protocol):
    """Makes what `PlaneSlam` closes loops with, out of the shared state and the fusion of landmarks."""

    def __call__(self, parts: Parts, merges: Merges, /) -> LoopCloser:
        """A loop closer for one run."""
        ...


class LoopCloser:
    """Looks for loops on the way, closes those it finds, and takes back what turns out to be none."""

    def __init__(self, parts: Parts, merges: Merges) -> None:
        self._keyframes, self._landmarks, self._backend = parts.keyframes, parts.landmarks, parts.backend
        self._merges, self._thinning, self._config = merges, parts.thinning, parts.config
        self.decisions: list[LoopDecision] = []
        self.ties: list[Tie] = []
        self._ways = array("d")
        self._looked_at_m = 0.0

    def look(self, scale: float) -> list[tuple[int, int]] | None:
        """Look for loops if it is time to; the pairs of landmarks that a closed one has made one, None without one.

        `scale` as in `Merges.doubted`.
        """
        rules, needed = self._config.loops, self._config.landmarks.min_observations
        self._ways.append(self._way())
        if rules.max_candidates == 0 or self._ways[-1] - self._looked_at_m < rules.every_m:
            return None
        self._looked_at_m = self._ways[-1]
        path = DrivenPath.of(self._thinning.held, np.array(self._ways), self._backend)
        decisions = find_loop(path, self._keyframes, self._landmarks, self._backend, rules, needed)
        self.decisions += decisions
        if not decisions or decisions[-1].verdict != "closed":
            return None
        pairs = [pair for pair in disjoint(decisions[-1].pairs) if self._merges.may_be_one(*pair)]
        if self._merges.close(pairs, scale):
            return pairs
        self.decisions[-1] = replace(decisions[-1], verdict="refused")
        return None

    def take_motion(self, pairs: Sequence[tuple[int, int]]) -> None:
        """What the returns say of the loop just closed beyond its walls (`pairs`): how far along a corridor it is."""
        loop = self.decisions[-1]
        if loop.motion is None:
            return
        for end in (loop.old_keyframe, loop.keyframe):
            self._thinning.stays(end)
        [index] = self._backend.update([_factor(loop, loop.motion)], gtsam.Values(), relinearize=True)
        self.ties.append(Tie(loop, loop.motion, tuple(pairs), index))
        self._landmarks.refresh(self._backend)

    def take_back(self, scale: float) -> None:
        """Take motions out of the graph whose loops turn out to be none; `scale` as in `Merges.doubted`.

        A loop is none when half of the walls that were joined for it, or more, were found to be two after all, or when
        the motion itself no longer fits.
        """
        wrong = [tie for tie in self.ties if tie.undone is None and self._is_refuted(tie, scale)]
        if not wrong:
            return
        self._backend.update([], gtsam.Values(), remove=[tie.factor_index for tie in wrong], relinearize=True)
        self._backend.settle(_ROUNDS)
        self._landmarks.refresh(self._backend)
        self._merges.redraw(min(tie.loop.old_keyframe for tie in wrong))
        for tie in wrong:
            tie.undone = len(self._keyframes) - 1

    def renumber(self, moved: Mapping[int, int]) -> None:
        """The graph has been made anew: the new index of every factor by its old one."""
        for tie in self.ties:
            if tie.undone is None:
                tie.factor_index = moved[tie.factor_index]

    def _is_refuted(self, tie: Tie, scale: float) -> bool:
        split = sum(younger in self._landmarks for _, younger in tie.pairs)
        if tie.pairs and 2 * split >= len(tie.pairs):
            return True
        limit = float(chdtri(3, self._config.association.new_significance))
        return tie.misfit(self._backend) > max(scale, 1.0) * limit

    def _way(self) -> float:
        """Length of the way to the newest keyframe, m."""
        last = len(self._keyframes) - 1
        if not self._ways:
            return 0.0
        before, now = (self._backend.pose(pose_symbol(one))[:3, 3] for one in (last - 1, last))
        return self._ways[-1] + float(np.linalg.norm(now - before))


def _factor(loop: LoopDecision, motion: Motion) -> Any:
    """The motion as a factor between the ends of a loop."""
    return motion.factors(pose_symbol(loop.old_keyframe), pose_symbol(loop.keyframe))[0]
