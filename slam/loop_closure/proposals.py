"""Loop closure: proposals that wait until others agree with them, or until a trial closing shows them right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.loop_closure.candidates import old_keyframes
from slam.loop_closure.pairwise_consistency import Proposal, agree, joint_log_odds, loop_chi2, maximal_cliques
from slam.loop_closure.verification import Surroundings
from slam.registration.correlative_search import evidence_at
from slam.registration.submaps import PlanarPose

#: Most proposals that wait: older ones are forgotten first.
_MOST = 12


class Proposals:
    """Closures that were proposed and are not closed yet."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._waiting: list[Proposal] = []
        #: Whether the loops over two closures and the ways between them close.
        self._known: dict[tuple[Proposal, Proposal], bool] = {}

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
        new = [pair for pair in pairs if pair not in self._known]
        ways = _between([way for pair in new for way in _ways(*pair)], backend)
        for pair in new:
            newer, older = (ways[way] for way in _ways(*pair))
            self._known[pair] = agree(loop_chi2(*pair, newer, older), self._config.significance)
        agreeing = np.eye(len(self._waiting), dtype=bool)
        rows, columns = np.tril_indices(len(self._waiting), -1)
        agreeing[rows, columns] = agreeing[columns, rows] = [self._known[pair] for pair in pairs]
        return agreeing


def _ways(first: Proposal, second: Proposal) -> tuple[tuple[int, int], tuple[int, int]]:
    """The keyframes between which the estimate leads from one proposal to another: new ones, old ones."""
    return (first.keyframe, second.keyframe), (first.old_keyframe, second.old_keyframe)


def _between(ways: Sequence[tuple[int, int]], backend: Backend) -> dict[tuple[int, int], PlanarPose]:
    """Where keyframes (second) are from others (first) by the estimate."""
    apart = sorted({way for way in ways if way[0] != way[1]})
    found = PlanarPose.of_all([(pose_symbol(first), pose_symbol(second)) for first, second in apart], backend)
    same = {way: PlanarPose(np.zeros(3), np.zeros((3, 3))) for way in ways if way[0] == way[1]}
    return same | dict(zip(apart, found, strict=True))


#: Windows of travel for which a closed loop is on trial: what bends the way is seen no more.
_WINDOWS = 3.0
#: Headings and positions along each axis that are tried within the estimate's own uncertainty.
_N_TRIED = 13


@dataclass(eq=False)
class Trial:
    """What has been seen for and against a closed loop."""

    since_m: float
    """Length of the way when it was closed, m."""
    log_odds: float = float("nan")
    """Of the loop; NaN: nothing has been seen since."""
    heard_m: float = float("nan")
    """Length of the way when something was seen last, m."""

    @property
    def is_lost(self) -> bool:
        """Whether it is likelier that the loop was none."""
        return self.log_odds < 0.0

    def is_open(self, way_m: float, config: LoopConfig) -> bool:
        """Whether it still runs, so much way later."""
        return way_m - self.since_m <= _WINDOWS * config.window_m

    def update(self, evidence: float, way_m: float, config: LoopConfig) -> None:
        """Count what was seen so much way later, by the share of it that is new.

        `evidence`: log of how much better the returns fit the map as it is than what has nothing to do with it.
        """
        most = -2.0 * float(np.log(config.significance))  # what one closure must bring; no witness is surer than that
        before, since = (most, self.since_m) if np.isnan(self.log_odds) else (self.log_odds, self.heard_m)
        news = min((way_m - since) / config.window_m, 1.0)
        self.log_odds = min(before + news * evidence / config.looks_per_place, most)
        self.heard_m = way_m


def evidence_of_map(around: Surroundings) -> float | None:
    """How well what is seen now fits what was seen near here long ago, as the map now has it; None: nothing was.

    The best motion within the estimate's own uncertainty counts, and within what passes for tied, so that it is not
    held against a loop that a wall is a little off; where it is known much worse nothing is said. Returns where it was
    free space, and free space where there were walls, speak against the map.
    """
    path, now = around.path, len(around.path.lengths) - 1
    old = next(iter(old_keyframes(path, around.backend, around.config)), None)
    if old is None or around.keyframes[now].returns is None or around.keyframes[old].returns is None:
        return None
    here, there = around.view_about(now), around.view_about(old)
    if here is None or there is None:
        return None
    estimate = PlanarPose.of(pose_symbol(old), pose_symbol(now), around.backend)
    rules = around.config
    least = rules.tied_m * np.array((1.0, 1.0, 1.0 / rules.window_m))
    if estimate.reach_m > 2.0 * rules.tied_m:
        return None
    reach = np.maximum(BOUND_SIGMAS * np.sqrt(np.diag(estimate.covariance)), least)
    steps = np.linspace(-1.0, 1.0, _N_TRIED)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return float(evidence_at(here, there, np.ascontiguousarray(estimate.delta + grid * reach)).max())
