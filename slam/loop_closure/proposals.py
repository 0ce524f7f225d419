"""Loop closure: proposals that wait until others agree with them, or until they are beyond doubt by themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.config import LoopConfig
from slam.loop_closure.pairwise_consistency import (
    PlanarPose,
    Proposal,
    agree,
    joint_log_odds,
    loop_chi2,
    maximal_cliques,
)
from slam.registration.submaps import RelativePose

#: Most proposals that wait: older ones are forgotten first.
_MOST = 12


class Proposals:
    """Closures that were proposed and are not closed yet."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._waiting: list[Proposal] = []
        self._known: dict[tuple[int, int, int, int], bool] = {}

    def agreed(self, new: Proposal, held: Sequence[int], backend: Backend) -> list[Proposal]:
        """The proposals, the new one among them, that may be closed together; none: they wait.

        A group that agrees two by two is closed when its joint odds leave the significance to all else; one by itself
        when its own odds are what two would have had to bring: 1 / significance twice.
        """
        there = set(held)
        self._waiting = [one for one in self._waiting if {one.keyframe, one.old_keyframe} <= there][-_MOST:]
        self._waiting.append(new)
        enough = -float(np.log(self._config.significance))
        groups = [[self._waiting[i] for i in clique] for clique in maximal_cliques(self._agreeing(backend))]
        odds = {i: joint_log_odds(group, self._config.window_m) for i, group in enumerate(groups) if new in group}
        best = max(odds, key=lambda i: odds[i])
        return groups[best] if odds[best] >= enough * (2.0 if len(groups[best]) == 1 else 1.0) else []

    def forget(self, group: Sequence[Proposal]) -> None:
        """Proposals that were closed, or refused: the estimate is another one now."""
        self._known.clear()
        self._waiting = [one for one in self._waiting if one not in group]

    def _agreeing(self, backend: Backend) -> np.ndarray:
        """Which of those that wait agree two by two, shape (N, N)."""
        count = len(self._waiting)
        agreeing = np.eye(count, dtype=bool)
        for i in range(count):
            for j in range(i):
                agreeing[i, j] = agreeing[j, i] = self._agree(self._waiting[j], self._waiting[i], backend)
        return agreeing

    def _agree(self, first: Proposal, second: Proposal, backend: Backend) -> bool:
        """Whether the loop over two closures and the way between them closes."""
        ends = first.keyframe, first.old_keyframe, second.keyframe, second.old_keyframe
        if ends not in self._known:
            self._known[ends] = self._loop_closes(first, second, backend)
        return self._known[ends]

    def _loop_closes(self, first: Proposal, second: Proposal, backend: Backend) -> bool:
        newer, older = (
            _between(*ends, backend)
            for ends in ((first.keyframe, second.keyframe), (first.old_keyframe, second.old_keyframe))
        )
        return agree(loop_chi2(first, second, newer, older), self._config.significance)


def _between(first: int, second: int, backend: Backend) -> PlanarPose:
    """Where a keyframe is from another one by the estimate."""
    if first == second:
        return PlanarPose(np.zeros(3), np.zeros((3, 3)))
    found = RelativePose.of(pose_symbol(first), pose_symbol(second), backend)
    return PlanarPose(found.delta, found.covariance)
