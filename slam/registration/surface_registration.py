"""Registration of a 3D scan to a local map by all its returns: point to plane, with candidates verified.

Planes propose where a body is; all that it sees decides. Surface elements (`slam.frontend.scan_surfaces`) of the scan
are laid on those of the keyframes before, and what speaks against a place counts as well: surfaces that would stand
before others that are seen.

References:
    Chen, Medioni, "Object modelling by registration of multiple range images", IVC 1992, for point to plane.
    Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020, for a kernel that narrows.
    Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 2023, for thresholds that follow the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from slam.frontend.scan_surfaces import ON_EDGE, SHARE_ON_PLANE, THING_M, WIDTH, moved
from slam.geometry.frames import inverse, lift
from slam.registration._correspondence_kernels import may_have_changed, point_to_plane
from slam.registration.motion_prior import MotionPrior
from slam.registration.plane_registration import negative_log_prior
from slam.registration.visibility import ALIKE, Scan, tree_of
from spplanes._check import FloatArray

#: How far, in widths, partners are looked for in one stage after another; and the iterations of each.
_REACHES, _STEPS = (6.0, 3.0, 1.5, 1.0), 6
#: Residuals are weighed by a Geman-McClure kernel of so many robust standard deviations of all of them.
_KERNEL = 3.0
#: That is never taken for less than this, m.
_LEAST_SCALE_M = 0.003
#: A motion has converged when a step is smaller, rad and m.
_CONVERGED = 1e-4
#: Cells cut surfaces where they may: of patches that are narrower than wide directions err by more, by so many times as
#: a variance.
_CUT = 2.0
#: Candidates are told apart by about so many elements; places are one when no entry differs by more.
_SOME, _SAME = 700, 5e-3
#: Standard deviations of a motion that nothing says anything of, m and rad.
WEAK_M, WEAK_RAD = 10.0, 3.0
#: The same as information, GTSAM order.
WEAK_PRIOR = np.diag(np.repeat([WEAK_RAD, WEAK_M], 3) ** -2.0)
#: A place is told from others by the share of what is seen that fits there, less so many times the share that
#: contradicts: what a keyframe saw through is not there, while what it did not see may be.
_CONTRADICTION = 4.0
#: One that is better by one is likelier by so much, as a logarithm; and, by the square of that, by so much of each
#: thing that is seen. Places that were proposed for being alike differ by little, in all that is seen together; one
#: that fits much worse would do so by chance in thing after thing. All three by logistic regression of the true place
#: and the others at which each of 672 scans came to rest (lidars and depth cameras of 23 drives, seeds 270000 to
#: 270032, a real hall and a real camera, as they are and made worse): the loss is 5 nats, of what the newest keyframe
#: alone saw through 12, and 45 where what contradicts counts once. From 3 to 6 times the loss is about the same.
TELLING, _TELLING_AS_A_SQUARE = 18.0, 0.3
#: The same of each thing, of places none of which was proposed for being alike: scores differ by chance the less, the
#: more is seen. (0.70 by 577 other scans, 0.96 by the 292 of them whose seeds had not been looked at.)
_TELLING_OF_A_THING = 0.8


class Tried(NamedTuple):
    """A place at which a scan came to rest."""

    known_T_seen: FloatArray
    """Shape (4, 4)."""
    log_likelihood: float
    """By how well it fits and by what was expected, up to a constant."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """A scan laid on a local map."""

    known_T_seen: FloatArray
    """Shape (4, 4)."""
    information: FloatArray
    """Of the tangent on the right, GTSAM order (rotation, translation), by all elements, shape (6, 6)."""
    residuals: Residuals
    """Of all elements that found a partner, at the motion above."""
    score: float
    """Share of what is seen, by weight, that is where a surface is known, close by, less what the newest keyframe saw
    through."""
    share: float
    """Share of the elements that found a partner."""
    weight: float
    """How much is seen, in things; see `slam.frontend.scan_surfaces.weights_of`."""
    tried: tuple[Tried, ...]
    """All places that were looked at, the likeliest, which is the one above, first."""

    def log_odds(self, other: Alignment) -> float:
        """Of its place being the true one and not that where the same scan came to rest from another start, nats."""
        return _TELLING_OF_A_THING * self.weight * (self.score - other.score)


class LocalMap:
    """Surface elements of a few keyframes in one frame, to register scans on."""

    def __init__(self, parts: Sequence[tuple[FloatArray, Scan]]) -> None:
        """Of parts: known_T_body (4, 4) with what was seen from there."""
        rows = np.concatenate([moved(scan.elements, pose) for pose, scan in parts])
        edges = rows[:, 7] == ON_EDGE
        self.elements = np.concatenate((rows[~edges], rows[edges]))
        """Of all parts, those on edges last, shape (M, 9)."""
        self.trees = [tree_of(some[:, :3]) if len(some) else None for some in (rows[~edges], rows[edges])]
        """Of those on surfaces and of those on edges; None: there are none."""
        self._parts = parts

    def contradicted(
        self, known_T_seen: FloatArray, alone: FloatArray, scan: Scan, latest: int | None = None
    ) -> FloatArray:
        """How many things are seen through, as a share: what stands before what a keyframe saw, or it before the scan.

        Args:
            known_T_seen: the motion, shape (4, 4).
            alone: elements of the scan that have no partner, shape (M, 9).
            scan: all of it.
            latest: so many keyframes are asked, the newest; None: all.

        Returns:
            What each of them says, in order, shape (K,).
        """
        shares = []
        for pose, seen in self._parts[-latest if latest else None :]:
            there_T_seen = inverse(pose) @ known_T_seen
            back = _seen_through(moved(alone, there_T_seen), seen)
            ahead = _seen_through(moved(seen.elements, inverse(there_T_seen)), scan)
            shares.append(max(back / float(scan.weights.sum()), ahead / float(seen.weights.sum())))
        return np.array(shares)

    def between(self, known_T_seen: FloatArray, elements: FloatArray) -> FloatArray:
        """How far elements (N, 9) without a partner are from what some keyframe saw about them, (N,), m."""
        apart = np.full(len(elements), np.inf)
        for pose, scan in self._parts:
            apart = np.minimum(apart, scan.off_surfaces(moved(elements, inverse(pose) @ known_T_seen)))
        return apart


class Correspondences:
    """Elements of a scan, each with the known one of its sort that is nearest wherever the scan is laid.

    A descent takes small steps: where an element has moved by less than what lies between its nearest and the next, the
    nearest is the same, and is not looked for again.
    """

    def __init__(self, elements: FloatArray, known: LocalMap) -> None:
        """Of elements (N, 9)."""
        self.elements, self.known, self.widths = elements, known, elements[:, WIDTH]
        edges = elements[:, 7] == ON_EDGE
        pairs = zip((~edges, edges), known.trees, strict=True)
        self._sorts = [(sort, tree) for sort, tree in pairs if tree is not None]
        self._asked, self._nearest = np.full((len(elements), 3), np.inf), np.full(len(elements), -1)
        self._next_m = np.where(np.any([sort for sort, _ in self._sorts], axis=0), 0.0, np.inf)

    def nearest(self, points: FloatArray, reach: FloatArray) -> np.ndarray:
        """Of the elements at points (N, 3) the nearest known ones, shape (N,); -1: none in reach (N,), m."""
        open_ = may_have_changed(points, self._asked, self._nearest, self._next_m, self.known.elements, reach)
        first, bound = 0, float(reach.max(initial=0.0))
        for sort, tree in self._sorts:
            mine = np.flatnonzero(open_ & sort)
            if len(mine):
                far, index = tree.query(points[mine], k=2, distance_upper_bound=bound)
                self._nearest[mine] = np.where(index[:, 0] < tree.n, first + index[:, 0], -1)
                self._asked[mine], self._next_m[mine] = points[mine], np.minimum(far[:, 1], bound)
            first += tree.n
        return self._nearest


def most_information(elements: FloatArray) -> FloatArray:
    """Of a motion by elements (N, 9), if each found a partner without error: tangent on the right, GTSAM order, (6, 6).

    A registration of theirs knows less.
    """
    jacobian = np.hstack((np.cross(elements[:, :3], elements[:, 3:6]), elements[:, 3:6])) / elements[:, 6:7]
    return jacobian.T @ jacobian


def _seen_through(elements: FloatArray, scan: Scan) -> int:
    """How many things elements (N, 9) in a scan's frame are of that are none that it saw, but before what it saw."""
    apart = elements[scan.apart(elements[:, :3], _REACHES[-1] * elements[:, WIDTH]), :3]
    return _number_of_things(apart[scan.through(apart)])


def _number_of_things(points: FloatArray) -> int:
    """How many things points (N, 3), m, are of; see `THING_M`."""
    number = 0
    while len(points):
        middle = points[np.linalg.norm(points - points[0], axis=1) < THING_M].mean(axis=0)
        one = np.linalg.norm(points - middle, axis=1) < THING_M
        one[0] = True
        number, points = number + 1, points[~one]
    return number


class Expected(NamedTuple):
    """What is known of a motion before looking: along what the returns leave open it is as expected."""

    known_T_seen: FloatArray
    """Shape (4, 4)."""
    information: FloatArray
    """Of its tangent on the right, GTSAM order (rotation, translation), shape (6, 6)."""
    prior: MotionPrior | None = None
    """Where nobody measured the motion: places that it leads to are told apart by this, and not by the information."""

    def log_likelihood(self, known_T_seen: FloatArray) -> float:
        """Of a motion, with the tails that expectations have, up to a constant."""
        if self.prior is not None:
            off = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(self.known_T_seen) @ known_T_seen))
            return self.prior.log_likelihood(off[POSE3_TO_SP])
        turn, place = np.diag(self.information)[[0, 3]] ** -0.5
        return -negative_log_prior(inverse(self.known_T_seen) @ known_T_seen, (place, turn))


def align(scan: Scan, known: LocalMap, candidates: Sequence[FloatArray], expected: Expected | None = None) -> Alignment:
    """Lay a scan on a local map, from the likeliest of candidates, by all its returns and by what was expected.

    From each of them a scan comes to rest by the likelier of two descents. They are told apart by some of the elements;
    only the best is worked out with all. Where no returns speak, a descent would end anywhere: there what is expected
    does, or nothing moves.

    Args:
        scan: what is seen, not nothing.
        known: where it is laid.
        candidates: motions known_T_seen to start from, about right, shape (4, 4) each; of equals the first is taken.
        expected: what is known before looking; the information of the result is without it.
    """
    few, weights = slice(None, None, int(np.ceil(len(scan.elements) / _SOME))), scan.weights
    some = Correspondences(scan.elements[few], known)
    shares = weights[few] / weights[few].sum()
    starts = [
        candidate
        for k, candidate in enumerate(candidates)
        if not any(_are_same(candidate, other) for other in candidates[:k])
    ]
    rests = _rests(some, starts, expected)
    distinct = {id(end): end for ends in rests for end in ends}
    fits = {name: _fit(some, shares, end) for name, end in distinct.items()}
    latest = None if len(fits) > 1 else 1  # all keyframes tell places apart; the score is by the newest
    against = {name: known.contradicted(distinct[name], fit.alone, scan, latest) for name, fit in fits.items()}
    told = {name: fit.close - _CONTRADICTION * float(against[name].mean()) for name, fit in fits.items()}
    weight, most = float(weights.sum()), max(told.values())
    judged = {
        name: Tried(end, _log_likelihood(most - told[name], weight, end, expected)) for name, end in distinct.items()
    }
    rough = [max((judged[id(end)] for end in ends), key=lambda one: one.log_likelihood) for ends in rests]
    rough.sort(key=lambda one: -one.log_likelihood)  # stable: of equals the first
    motion, every = rough[0].known_T_seen, some
    fit, score = fits[id(motion)], fits[id(motion)].close - float(against[id(motion)][-1])
    if few.step > 1:
        every = Correspondences(scan.elements, known)
        for reach in _REACHES[-2:]:
            motion = _Stage(every, expected, reach).descend(motion)
    found = Residuals.of(every, motion, _REACHES[-1] * every.widths)
    return Alignment(motion, found.information(), found, score, fit.share, weight, tuple(rough))


def _rests(some: Correspondences, starts: Sequence[FloatArray], expected: Expected | None) -> list[list[FloatArray]]:
    """Where some elements come to rest from each start, by two descents; of both ends one where they are one.

    The kernel follows the residuals; or it narrows with the reach (graduated non-convexity), and follows them in the
    last stage alone. Most are of floor and walls, which a motion along them leaves where they are, and a kernel as
    narrow as these are close is blind to the pillars that tell it; a wide one is led astray by clutter. Whatever has
    become one place on the way goes on as one.
    """
    motions = [(start, start) for start in starts]
    for reach in _REACHES:
        following = _Stage(some, expected, reach)
        narrowing = following
        if reach > _REACHES[-1]:
            narrowing = _Stage(some, expected, reach, kernel=reach * some.widths)
        motions = [(following.descend(one), narrowing.descend(other)) for one, other in motions]
    return [[one] if one is other else [one, other] for one, other in motions]


class _Stage:
    """One stage of descents: to the motion at which the residuals are least, by Gauss and Newton."""

    def __init__(
        self, scan: Correspondences, expected: Expected | None, reach: float, kernel: FloatArray | None = None
    ) -> None:
        """Of a scan's elements, partners looked for so many widths far; `kernel` as in `Residuals.of`."""
        self._scan, self._expected, self._reach, self._kernel = scan, expected, reach * scan.widths, kernel
        self._ends: list[tuple[FloatArray, FloatArray]] = []

    def descend(self, start: FloatArray) -> FloatArray:
        """The motion where a descent from one ends, shape (4, 4); from one and the same it is the same array."""
        for known, end in self._ends:
            if _are_same(known, start):
                return end
        motion = start
        for _ in range(_STEPS):
            residuals = Residuals.of(self._scan, motion, self._reach, self._kernel)
            step = residuals.step(motion, self._expected)
            motion = motion @ gtsam.Pose3.Expmap(step).matrix()
            if np.abs(step).max() < _CONVERGED:
                break
        self._ends.append((start, motion))
        return motion


def _are_same(motion: FloatArray, other: FloatArray) -> bool:
    """Whether from two motions a descent ends at one."""
    return bool(np.abs(motion - other).max() < _SAME)


def _log_likelihood(less: float, weight: float, motion: FloatArray, expected: Expected | None) -> float:
    """Of a place that is so much worse than the best one, up to a constant; `weight` of what is seen."""
    prior = 0.0 if expected is None else expected.log_likelihood(motion)
    return prior - less * (TELLING + _TELLING_AS_A_SQUARE * weight * less)


class _Fit(NamedTuple):
    """How some of a scan's elements fit where they came to rest."""

    close: float
    """Share of them, by weight, that is where a surface is known, close by."""
    share: float
    """Share of them with a partner."""
    alone: FloatArray
    """The others, shape (M, 9)."""


def _fit(some: Correspondences, shares: FloatArray, motion: FloatArray) -> _Fit:
    """How some of a scan's elements fit at a motion known_T_seen (4, 4); they say so much of all, shares (N,).

    Beams move with the sensor: were only those elements counted that come to lie on another, the place where nothing
    moved would win, at which all do. On a surface that was seen on all sides of it, an element fits as well.
    """
    elements, known = some.elements, some.known
    found = Residuals.of(some, motion, _REACHES[-1] * some.widths)
    alone = np.ones(len(elements), dtype=bool)
    alone[found.index] = False
    close = shares[found.index] @ closeness(found.off, elements[found.index])
    close += shares[alone] @ closeness(known.between(motion, elements[alone]), elements[alone])
    return _Fit(float(close), len(found.off) / len(elements), elements[alone])


@dataclass(frozen=True, eq=False)
class Residuals:
    """How far elements are from their partners, along the partners' directions."""

    index: np.ndarray
    """Which elements, shape (K,)."""
    partners: np.ndarray
    """Of the known ones, shape (K,)."""
    off: FloatArray
    """Shape (K,), m."""
    jacobian: FloatArray
    """By the tangent of the motion on the right, shape (K, 6)."""
    weights: FloatArray
    """Information of each, by its noise and the robust kernel, shape (K,), 1 / m^2."""
    tilts: FloatArray
    """Variances of the partners' directions, shape (K,), rad^2."""

    @classmethod
    def of(
        cls,
        scan: Correspondences,
        motion: FloatArray,
        reach: FloatArray,
        kernel: FloatArray | None = None,
    ) -> Residuals:
        """Of a scan's elements at a motion (4, 4).

        Args:
            scan: its elements, and where partners are looked for.
            motion: known_T_seen.
            reach: how far off they may be, shape (N,), m.
            kernel: width of the robust kernel, shape (N,), m; None: by how far off most are.
        """
        nearest, known = scan.nearest(lift(scan.elements[:, :3], motion), reach), scan.known.elements
        index, off, jacobian, variance, tilts = point_to_plane(scan.elements, motion, nearest, known, reach, ALIKE)
        usual = max(_LEAST_SCALE_M, 1.4826 * float(np.median(np.abs(off))) if len(off) else 0.0)
        believed = 1.0 / (1.0 + (off / (_KERNEL * usual if kernel is None else kernel[index])) ** 2) ** 2
        return cls(index, nearest[index], off, jacobian, believed / variance, tilts)

    def information(self) -> FloatArray:
        """Of the motion by all of them, shape (6, 6)."""
        return self._known(np.ones(len(self.off), dtype=bool))

    def _seeming(self, some: np.ndarray | slice = slice(None)) -> FloatArray:
        """Information of some of them, mask (K,), or of all, if directions were exact."""
        return self.jacobian[some].T @ (self.weights[some, None] * self.jacobian[some])

    def _known(self, some: np.ndarray) -> FloatArray:
        """Information of some of them, mask (K,), without what they seem to know of the place by noise of directions.

        Patches of a few points look every way by chance: some hundred of them on a bare floor fixed the way along a
        corridor to a centimetre. Tilted by e, a direction across which a body moves adds e^2 to what is known of that:
        along what the others leave open, patches say what they say beyond that.
        """
        tilted = some & (self.tilts > 0.0)
        by_others, by_tilted = self._seeming(some & ~tilted), self._seeming(tilted)
        axes = np.linalg.eigh(by_others[3:, 3:])[1]
        share, along = self.weights[tilted] * self.tilts[tilted], self.jacobian[tilted, 3:] @ axes
        by_chance = _CUT * (share[:, None] * (1.0 - along**2)).sum(axis=0)
        seeming = np.einsum("ia,ij,ja->a", axes, by_tilted[3:, 3:], axes)
        kept = np.sqrt(np.clip(1.0 - by_chance / np.maximum(seeming, 1e-12), 0.0, 1.0))
        scale = np.eye(6)
        scale[3:, 3:] = (axes * kept) @ axes.T
        return by_others + scale @ by_tilted @ scale

    def step(self, motion: FloatArray, expected: Expected | None) -> FloatArray:
        """Of Gauss and Newton, toward less of them and toward what is expected, tangent of the motion, (6,)."""
        told, prior = self.jacobian.T @ (self.weights * self.off), WEAK_PRIOR
        if expected is not None:
            prior = expected.information
            told = told + prior @ gtsam.Pose3.Logmap(gtsam.Pose3(inverse(expected.known_T_seen) @ motion))
        return np.linalg.solve(self._seeming() + prior, -told).astype(np.float64)

    def told_by(self, elements: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Information of some elements, mask (N,), and information times their mean, about the motion."""
        some = elements[self.index]
        told = -self.jacobian[some].T @ (self.weights[some] * self.off[some])
        known = self._known(some)
        return known, known @ np.linalg.solve(self._seeming(some) + WEAK_PRIOR, told)


def closeness(off: FloatArray, elements: FloatArray) -> FloatArray:
    """How close elements (N, 9) are to what is known, (N,), one at most: distances of them, (N,), m.

    Where few beams make elements wide, what is close does not grow with that.
    """
    widths = np.minimum(elements[:, WIDTH], SHARE_ON_PLANE * np.linalg.norm(elements[:, :3], axis=1))
    return 1.0 / (1.0 + (off / (0.25 * widths + _LEAST_SCALE_M)) ** 2)
