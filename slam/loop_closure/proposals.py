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
        pairs = [(self._waiting[j], self._waiting[i]) for i in range(len(self._waiting)) for j in range(i)]
        self._look_up([pair for pair in pairs if _ends(*pair) not in self._known], backend)
        agreeing = np.eye(len(self._waiting), dtype=bool)
        rows, columns = np.tril_indices(len(self._waiting), -1)
        agreeing[rows, columns] = agreeing[columns, rows] = [self._known[_ends(*pair)] for pair in pairs]
        return agreeing

    def _look_up(self, pairs: Sequence[tuple[Proposal, Proposal]], backend: Backend) -> None:
        """Whether the loops over two closures each and the way between them close."""
        ways = _between([way for pair in pairs for way in _ways(*pair)], backend)
        for first, second in pairs:
            newer, older = (ways[way] for way in _ways(first, second))
            closes = agree(loop_chi2(first, second, newer, older), self._config.significance)
            self._known[_ends(first, second)] = closes


def _ends(first: Proposal, second: Proposal) -> tuple[int, int, int, int]:
    """The keyframes at the ends of two proposals."""
    return first.keyframe, first.old_keyframe, second.keyframe, second.old_keyframe


def _ways(first: Proposal, second: Proposal) -> tuple[tuple[int, int], tuple[int, int]]:
    """The keyframes between which the estimate leads from one proposal to another: new ones, old ones."""
    return (first.keyframe, second.keyframe), (first.old_keyframe, second.old_keyframe)


def _between(ways: Sequence[tuple[int, int]], backend: Backend) -> dict[tuple[int, int], PlanarPose]:
    """Where keyframes (second) are from others (first) by the estimate."""
    apart = sorted({way for way in ways if way[0] != way[1]})
    found = RelativePose.of_all([(pose_symbol(first), pose_symbol(second)) for first, second in apart], backend)
    same = {way: PlanarPose(np.zeros(3), np.zeros((3, 3))) for way in ways if way[0] == way[1]}
    return same | {way: PlanarPose(one.delta, one.covariance) for way, one in zip(apart, found, strict=True)}
