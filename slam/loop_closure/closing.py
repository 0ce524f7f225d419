"""Loop closure: every metre or so, is what is seen now a place of long ago? Then their walls are joined."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.backend.estimator import Backend, pose_symbol
from slam.frontend.odometry import Motion
from slam.frontend.pose_measurements import PlaceMatch
from slam.loop_closure.candidates import DrivenPath
from slam.loop_closure.pairwise_consistency import Proposal, counted_once
from slam.loop_closure.proposals import Proposals, Trial, evidence_of_map
from slam.loop_closure.verification import LoopDecision, Surroundings, compare_with_old, joined, proposed, without_walls
from slam.map.state import EstimatorState
from slam.mapping.fusion import Merges
from slam.mapping.same_plane import disjoint
from slam.registration.submaps import anchored

#: After a loop that is taken back the estimate goes back a long way: so often iSAM2 relinearises.
_ROUNDS = 5


@dataclass(frozen=True)
class Closure:
    """What one look closed."""

    loops: tuple[LoopDecision, ...]
    """The comparisons that found the places."""
    pairs: tuple[tuple[int, int], ...] = ()
    """The landmarks (older, younger) that were joined for them; none: the places are tied by the motions alone."""


@dataclass(eq=False)
class ClosedLoop:
    """A closed loop: the walls that were joined for it, and the motion that the returns tell between its two ends."""

    loop: LoopDecision
    pairs: tuple[tuple[int, int], ...]
    """The landmarks (older, younger) that were joined with it."""
    factor_index: int | None
    """Index of the factor of the motion."""
    factor: Any
    """That factor; None: its walls say all."""
    trial: Trial
    undone: int | None = None
    """The keyframe at which it was found wrong; None: it stands."""

    @property
    def motion(self) -> Motion | None:
        """From the old keyframe to the newer one."""
        return self.loop.motion

    def misfit(self, backend: Backend) -> float:
        """Chi2 of the motion at the current estimate."""
        if self.factor is None:
            return 0.0
        return 2.0 * float(self.factor.error(backend.values_of(self.factor.keys())))


class LoopCloser:
    """Looks for loops on the way, closes those that are beyond doubt, and takes back what turns out to be none."""

    def __init__(self, state: EstimatorState, merges: Merges) -> None:
        self._keyframes, self._landmarks, self._backend = state.keyframes, state.landmarks, state.backend
        self._merges, self._sparsifier, self._config = merges, state.sparsifier, state.config
        self.decisions: list[LoopDecision] = []
        self.closed: list[ClosedLoop] = []
        self._proposals = Proposals(state.config.loops)
        self._ways = array("d")
        self._looked_at_m = 0.0

    def look(self, scale: float) -> Closure | None:
        """Look for loops if it is time to, and join the walls of those that are beyond doubt; None: there are none.

        `scale` as in `Merges.doubted`.
        """
        rules, needed = self._config.loops, self._config.landmarks.min_observations
        self._ways.append(self._way())
        given = [place for place in self._keyframes[-1].places if not (place.inferred or place.is_spatial)]
        is_time = rules.max_candidates > 0 and self._ways[-1] - self._looked_at_m >= rules.every_m
        if not is_time and not given:
            return None
        path = DrivenPath.of(self._sparsifier.held, np.array(self._ways), self._backend)
        around = Surroundings(path, self._keyframes, self._landmarks, self._backend, rules, needed)
        closed = [one for one in self._given(given, around) if one.verdict == "closed"]
        if closed or not is_time:
            return self._close(closed, scale) if closed else None
        self._looked_at_m = self._ways[-1]
        self._try_again(around)
        if len(given) < len(self._keyframes[-1].places):
            return None  # where it is from earlier ones is known by all of the drive
        for decision in compare_with_old(around):
            self.decisions.append(decision)
            closed = self._accepted(decision, around)
            if closed:
                return self._close(closed, scale)
        return None

    def fix(self, closure: Closure) -> None:
        """Put in what the returns say of the loops just closed beyond their walls: how far along a corridor."""
        for end in (end for loop in closure.loops for end in (loop.old_keyframe, loop.keyframe)):
            self._sparsifier.stays(end)  # both ends are needed in the graph
        factors = [
            None if one.motion is None else one.motion.factor(*map(pose_symbol, (one.old_keyframe, one.keyframe)))
            for one in closure.loops
        ]
        told = [one for one in factors if one is not None]
        indices = iter(self._backend.update(told, gtsam.Values(), relinearize=True) if told else ())
        for loop, factor in zip(closure.loops, factors, strict=True):
            index = None if factor is None else next(indices)
            self.closed.append(ClosedLoop(loop, closure.pairs, index, factor, Trial(self._ways[-1])))
        self._backend.settle(_ROUNDS if told else 0)
        self._landmarks.refresh(self._backend)

    def take_back(self, scale: float) -> None:
        """Take loops out of the graph that turn out to be none, motions and walls; `scale` as in `Merges.doubted`.

        A loop is none when half of the walls that were joined for it, or more, were found to be two after all, when the
        motion itself no longer fits, or when what is seen on the way on contradicts what was seen there before.
        """
        wrong = [known for known in self.closed if known.undone is None and self._is_refuted(known, scale)]
        if not wrong:
            return
        indices = [known.factor_index for known in wrong if known.factor_index is not None]
        self._backend.update([], gtsam.Values(), remove=indices, relinearize=True)
        for known in wrong:
            known.undone = len(self._keyframes) - 1
        pairs = {pair for known in wrong for pair in known.pairs}
        for merge in reversed(self._merges.history):
            if merge.undone is None and merge.cause == "loop" and (merge.older, merge.younger) in pairs:
                self._merges.undo(merge)
        self._backend.settle(_ROUNDS)
        self._landmarks.refresh(self._backend)
        self._merges.redraw(min(known.loop.old_keyframe for known in wrong))

    def _try_again(self, around: Surroundings) -> None:
        """Hold the loops of late against what is seen on the way on."""
        way, rules = self._ways[-1], self._config.loops
        late = [known.trial for known in self.closed if known.undone is None and known.trial.is_open(way, rules)]
        evidence = evidence_of_map(around) if late else None
        if evidence is not None:
            for trial in late:
                trial.update(evidence, way, rules)

    def _given(self, matches: Sequence[PlaceMatch], around: Surroundings) -> list[LoopDecision]:
        """What becomes of the places that the newest keyframe is known to stand near."""
        now, way_m, decisions = len(self._keyframes) - 1, float(around.path.lengths[-1]), []
        for match in matches:
            base, pose = anchored(match, self._backend)
            proposal = Proposal(now, gtsam.Symbol(base).index(), pose, np.inf, way_m)
            decision = proposed(proposal, around)
            decisions.append(decision if decision.verdict == "known" else joined(decision, proposal, around))
        self.decisions += decisions
        return decisions

    def _accepted(self, decision: LoopDecision, around: Surroundings) -> list[LoopDecision]:
        """The loops that may be closed now that this comparison has been made, the newest last."""
        if decision.proposal is None:
            return [decision] if decision.verdict == "closed" else []
        group = self._proposals.agreed(decision.proposal, self._sparsifier.held, self._backend)
        if not group:
            return []
        self._proposals.forget(group)
        rules = self._config.loops
        closed_m = max((known.trial.since_m for known in self.closed if known.undone is None), default=-np.inf)
        counted = counted_once(group, rules.window_m, rules.every_m, closed_m)
        ends = [(one.keyframe, one.old_keyframe) for one in self.decisions]
        numbers = [ends.index((one.keyframe, one.old_keyframe)) for one in counted]
        for number, proposal in zip(numbers, counted, strict=True):
            self.decisions[number] = joined(self.decisions[number], proposal, around)
        return [self.decisions[number] for number in sorted(numbers) if self.decisions[number].verdict == "closed"]

    def _close(self, loops: list[LoopDecision], scale: float) -> Closure | None:
        """Join the walls of loops that agree, or where the graph as a whole is against that, fix their places alone."""
        found = disjoint([pair for loop in loops for pair in loop.pairs])
        pairs = [pair for pair in found if self._merges.may_be_one(*pair)]
        if self._merges.close(pairs, scale):
            return Closure(tuple(loops), tuple(pairs))
        alone = [without_walls(loop) or replace(loop, verdict="refused") for loop in loops]
        for loop, one in zip(loops, alone, strict=True):
            self.decisions[self.decisions.index(loop)] = one
        closed = tuple(one for one in alone if one.verdict == "closed")
        if not closed:
            return None
        self._merges.reconsider(pairs)  # the place is beyond doubt, which of its walls are one is not
        return Closure(closed)

    def _is_refuted(self, known: ClosedLoop, scale: float) -> bool:
        split = sum(younger in self._landmarks for _, younger in known.pairs)
        if known.trial.is_lost or (known.pairs and 2 * split >= len(known.pairs)):
            return True
        limit = float(chdtri(3, self._config.association.new_significance))
        return known.misfit(self._backend) > max(scale, 1.0) * limit

    def _way(self) -> float:
        """Length of the way to the newest keyframe, m."""
        last = len(self._keyframes) - 1
        if not self._ways:
            return 0.0
        before, now = (self._backend.pose(pose_symbol(one))[:3, 3] for one in (last - 1, last))
        return self._ways[-1] + float(np.linalg.norm(now - before))


#: Makes what `PlaneSlam` closes loops with for one run, out of the shared state and the fusion of landmarks.
LoopClosing = Callable[[EstimatorState, Merges], LoopCloser]
