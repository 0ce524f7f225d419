"""Loop closure: closed loops on trial, by what is seen on the way on in the free space and on the walls of before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import pose_symbol
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.loop_closure.candidates import old_keyframes
from slam.loop_closure.verification import Surroundings
from slam.registration.correlative_search import evidence_at
from slam.registration.submaps import RelativePose
from spplanes._check import FloatArray

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

    def hear(self, evidence: float, way_m: float, config: LoopConfig) -> None:
        """Count what was seen, by the share of it that is new.

        Args:
            evidence: log of how much better the returns fit the map as it is than what has nothing to do with it.
            way_m: length of the way, m.
            config: the rules.
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
    estimate = RelativePose.of(pose_symbol(old), pose_symbol(now), around.backend)
    rules = around.config
    least = rules.tied_m * np.array((1.0, 1.0, 1.0 / rules.window_m))
    if estimate.reach_m > 2.0 * rules.tied_m:
        return None
    reach = np.maximum(BOUND_SIGMAS * np.sqrt(np.diag(estimate.covariance)), least)
    return float(evidence_at(here, there, _motions_about(estimate.delta, reach)).max())


def _motions_about(delta: FloatArray, reach: FloatArray) -> FloatArray:
    """A grid of motions (x, y, theta) about one, half sides `reach`, shape (M, 3)."""
    steps = np.linspace(-1.0, 1.0, _N_TRIED)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.ascontiguousarray(delta + grid * reach)
