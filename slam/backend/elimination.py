"""The tree of iSAM2: how factors enter and leave it, what is relinearised when, and what is eliminated last."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from factors import isam2_parameters
from slam.config import BackendConfig
from slam.timing import StageClock, timed

#: Letters of the symbols of poses: of a keyframe, of a prior map.
POSE_CODES = tuple(map(ord, "xm"))
#: All variables that have moved are relinearised at one of so many updates, two of which a keyframe takes; those in use
#: at every one. An odd number: it falls on predictions and on what is seen in turn.
_ALL_EVERY = 21

#: What GTSAM says, in Python by a RuntimeError as any other, when elimination fails.
INDETERMINATE = "Indeterminate linear system"


class BackendError(RuntimeError):
    """The graph cannot be solved; the sentence says near which variable."""


class Elimination(ABC):
    """iSAM2 that eliminates by Cholesky's method, and by QR from where that gives up.

    Cholesky takes a third of QR's time. Normal equations square a condition number that long corridors make large:
    after 300 poses of a 1 m step, 1 cm / 0.01 rad odometry, and walls and floors of 50 m, GTSAM calls them
    indeterminate. Up to there the covariances of the two are the same to eight digits.
    """

    def __init__(self, config: BackendConfig) -> None:
        self._thresholds = _thresholds(config)
        self.clock = StageClock()
        self._isam = self._empty("CHOLESKY")
        self._n_updates = 0
        self._used: set[int] = set()
        #: The variables of the last updates and questions, about three keyframes: they stay where the tree begins.
        self._recent: deque[set[int]] = deque(maxlen=10)
        self._not_in_use = gtsam.KeyList()
        self._listed: set[int] = set()  # in that list, which cannot be read
        self._forget()

    @abstractmethod
    def _forget(self) -> None:
        """The graph has changed: what was read out of it before holds no more."""

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor still in the graph."""
        factors = self._isam.getFactorsUnsafe()
        return graph_of(factors.at(index) for index in range(factors.size()) if factors.exists(index))

    @timed("optimise")
    def update(
        self, factors: Iterable[Any], initial: gtsam.Values, remove: Sequence[int] = (), *, relinearize: bool = False
    ) -> list[int]:
        """Add factors and variables, remove factors by index; returns the indices of the new factors.

        Of what has moved the variables in use, those of these factors and of the ones before, are relinearised first:
        gates are drawn and estimates made by them. The others, which a correction moves a little all along the way, are
        every so often, and where `relinearize` asks for it, once more after. BackendError: it became indeterminate.
        """
        graph = graph_of(factors)
        used = set(graph.keyVector())
        held = None if relinearize else self._out_of_use(used)
        last = self._eliminated_last(used)
        indices, _ = self._step(graph, initial, list(remove), constrainedKeys=last, noRelinKeys=held)
        if relinearize:
            self._step()
        return indices

    def _eliminated_last(self, keys: Iterable[int]) -> gtsam.KeyGroupMap:
        """These and the recent variables: the tree begins with what is eliminated last, and to ask there is cheap.

        What iSAM2 is not told it eliminates early. Of the last two poses of 600 a joint covariance took 11 ms, a path
        through the tree, and takes 0.4 ms.
        """
        now, groups = set(keys), gtsam.KeyGroupMap()
        self._recent.append(now)
        for key in sorted(set().union(*self._recent)):
            if key in now or self._isam.valueExists(key):
                groups.insert2(key, 1)
        return groups

    def _bring_up(self, keys: Sequence[int]) -> None:
        """Put variables where the tree begins: they are asked about, and mostly seen next."""
        below = set(keys).difference(*self._recent)
        if below:
            last, others = self._eliminated_last(keys), self._all_but(set())
            self._step(constrainedKeys=last, noRelinKeys=others, extraReelimKeys=_key_list(below))

    def _out_of_use(self, used: set[int]) -> gtsam.KeyList | None:
        """Keys of the variables that need not be relinearised when factors of some are added; None: all may be."""
        in_use, self._used = used | self._used, used
        self._n_updates += 1
        return None if self._n_updates % _ALL_EVERY == 0 else self._all_but(in_use)

    def _all_but(self, in_use: set[int]) -> gtsam.KeyList:
        """The keys of all other variables: a list kept up to date, for a new one takes as long as a marginal."""
        wanted = set(self._isam.getLinearizationPoint().keys()) - in_use
        for key in self._listed - wanted:
            self._not_in_use.remove(key)
        for key in wanted - self._listed:
            self._not_in_use.push_back(key)
        self._listed = wanted
        return self._not_in_use

    @timed("optimise")
    def relinearize_in_use(self) -> None:
        """Once more at the estimate what the last factors are of, and nothing else."""
        self._step(noRelinKeys=self._all_but(self._used))

    @timed("optimise")
    def exchange(self, factors: Iterable[Any], remove: Sequence[int], leaving: Iterable[int]) -> list[int]:
        """Put factors in the place of many others, with which variables leave; returns the indices of the new ones.

        Everything is eliminated anew in an order that suits the new graph. By itself iSAM2 puts the variables that
        changed last: where the ends of a long loop became one (470 factors of 6097) that took 1.03 s, this 0.15 s.
        BackendError: the system became indeterminate.
        """
        staying = _key_list(set(self._isam.getLinearizationPoint().keys()).difference(leaving))
        return self._step(graph_of(factors), gtsam.Values(), list(remove), extraReelimKeys=staying)[0]

    @timed("optimise")
    def settle(self, rounds: int) -> None:
        """Relinearise a few times over, until nothing moves: after something that moved the estimate far."""
        for _ in range(rounds):
            if not self._step()[1]:
                break

    def _step(self, *change: Any, **keys: gtsam.KeyGroupMap | gtsam.KeyList | None) -> tuple[list[int], int]:
        """One update: the indices of the factors that are new, and how many variables were relinearised."""
        n_before = self._isam.getFactorsUnsafe().size()
        try:
            result = self._isam.update(*change, **keys)
            return list(result.getNewFactorsIndices()), result.getVariablesRelinearized()
        except RuntimeError as error:
            self._isam = self._by_qr(error)
            n_now = self._isam.getFactorsUnsafe().size()
            return list(range(n_before, n_now)), self._isam.getLinearizationPoint().size()
        finally:
            self._forget()

    def _by_qr(self, failure: RuntimeError) -> gtsam.ISAM2:
        """The same factors under the same indices, linearised where they are, eliminated by QR after a failure.

        Of an update whose elimination failed iSAM2 has all but the tree.
        """
        if INDETERMINATE not in str(failure):
            raise BackendError(first_line(failure)) from failure
        factors, linearised = self._isam.getFactorsUnsafe(), self._isam.getLinearizationPoint()
        twin = self._empty("QR")
        try:
            twin.update(factors, linearised.extract(factors.keyVector()))  # without what leaves with its last factor
        except RuntimeError as error:
            raise BackendError(first_line(error)) from error
        return twin

    def _empty(self, factorization: str) -> gtsam.ISAM2:
        parameters = isam2_parameters()
        parameters.setFactorization(factorization)
        parameters.setRelinearizeThreshold(self._thresholds)
        return gtsam.ISAM2(parameters)

    def snapshot(self) -> gtsam.ISAM2:
        """The graph and its estimate as they are, for `restore`."""
        return gtsam.ISAM2(self._isam)

    def restore(self, snapshot: gtsam.ISAM2) -> None:
        """Go back to a snapshot, as if nothing had been done since, bit for bit; it is used up. Poses did not leave."""
        self._isam = snapshot
        self._forget()

    @timed("optimise")
    def rebuild(self, values: gtsam.Values) -> None:
        """Start anew from other values with the same factors, under the same indices."""
        old = self._isam
        self._isam = self._empty("CHOLESKY")
        self._step(old.getFactorsUnsafe(), values)


def _key_list(keys: Iterable[int]) -> gtsam.KeyList:
    ascending = gtsam.KeyList()
    for key in sorted(keys):
        ascending.push_back(key)
    return ascending


def graph_of(factors: Iterable[Any]) -> gtsam.NonlinearFactorGraph:
    """A graph of these factors."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def _thresholds(config: BackendConfig) -> gtsam.ISAM2ThresholdMap:
    """Changes of poses (of the body, and of a prior map) and of planes (tilt, distance) that relinearise them.

    Planes that are parallel, or level, fix nothing along them. Linearised at normals that are off, they do: a floor off
    by 4 mrad, its height measured to 0.2 mm from every keyframe, says to 5 cm where the body is, each time.
    """
    thresholds, change = gtsam.ISAM2ThresholdMap(), config.relinearize_threshold
    for letter in map(chr, POSE_CODES):
        thresholds.insert((letter, np.full(6, change)))
    tilt = min(config.relinearize_tilt_rad, change)
    thresholds.insert(("p", np.array((tilt, tilt, change))))
    return thresholds


def is_pose(key: int) -> bool:
    """Whether a key is that of a pose, of a keyframe or of a prior map."""
    return key >> 56 in POSE_CODES


def first_line(error: Exception) -> str:
    """What GTSAM says of a failure, without its advice."""
    return " ".join(str(error).split("\n\n")[0].split())
