"""Every metre or so: is what is seen now a place of long ago? Then its walls are joined with those of then."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import gtsam
import numpy as np

from slam.backend import Backend, pose_symbol
from slam.config import SlamConfig
from slam.driven import DrivenPath
from slam.keyframes import Keyframe
from slam.landmarks import LandmarkMap
from slam.loops import LoopDecision, disjoint, find_loop
from slam.merging import Merges
from slam.thinning import Thinning


class LoopCloser:
    """Looks for loops on the way, and closes those it finds."""

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        landmarks: LandmarkMap,
        backend: Backend,
        merges: Merges,
        thinning: Thinning,
        config: SlamConfig,
    ) -> None:
        self._keyframes, self._landmarks, self._backend = keyframes, landmarks, backend
        self._merges, self._thinning, self._config = merges, thinning, config
        self.decisions: list[LoopDecision] = []
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
        return pairs if self._merges.close(pairs, scale) else None

    def take_motion(self) -> None:
        """What the returns say of the loop just closed beyond its walls: how far along a corridor the robot is."""
        loop = self.decisions[-1]
        if loop.motion is None:
            return
        self._thinning.stays(loop.keyframe)
        step = loop.motion.factors(pose_symbol(loop.old_keyframe), pose_symbol(loop.keyframe))[0]
        self._backend.update([step], gtsam.Values(), relinearize=True)
        self._landmarks.refresh(self._backend)

    def _way(self) -> float:
        """Length of the way to the newest keyframe, m."""
        last = len(self._keyframes) - 1
        if not self._ways:
            return 0.0
        before, now = (self._backend.pose(pose_symbol(one))[:3, 3] for one in (last - 1, last))
        return self._ways[-1] + float(np.linalg.norm(now - before))
