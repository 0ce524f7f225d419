"""Plane registration: where a body is, by its planes and those it knew, when the motion between is hardly known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import bdtrc

from slam.geometry.frames import angle_of, inverse
from slam.geometry.polygons import flatten, valid
from slam.registration._plane_arrays import PlaneArrays
from slam.registration._plane_kernels import best_shifts, directions_found, partners, unlike
from slam.registration.motion_from_planes import fit_pairs
from slam.registration.visibility import LinesOfSight
from spplanes import Plane
from spplanes._check import FloatArray

#: Two planes are one under a motion up to these, rad and m, and when their outlines come this near, m.
_ANGLE, _DISTANCE, _GAP = np.deg2rad(3.5), 0.10, 0.5
#: The same, as standard deviations, once a motion is worked out.
_FINE_ANGLE, _FINE_DISTANCE = np.deg2rad(1.0), 0.03
#: A motion is worked out with the pairs that it has roughly, then once more with those it has by then: times that
#: planes may be off what they usually are.
_LOOSE = (5.0, 1.0)
#: A motion is looked for as far as so many standard deviations; what it costs grows slower beyond the first few.
_FAR, _TAIL = 6.0, 2.0
#: Whatever carries a sensor keeps upright: standard deviation of its tilt, however long nobody looked, rad.
_TILT_RAD = 0.5
#: Motions whose outlines are compared.
_MOTIONS = 20
#: What is hidden from one place and not from the next changes scores by such a share of what is seen.
_ALIKE = 0.03


@dataclass(frozen=True, eq=False)
class PlaneMatching:
    """The motion under which most of what is seen is known."""

    known_T_seen: FloatArray
    """Takes the seen planes' frame to the known ones', shape (4, 4)."""
    covariance: FloatArray
    """Of its tangent on the right, GTSAM order (rotation, translation), shape (6, 6); wide where no pair speaks."""
    pairs: tuple[tuple[int, int], ...]
    """(seen, known) of the planes that are one under it."""

    @property
    def n_matched(self) -> int:
        """How many planes are in both; pieces of one count once."""
        return _in_both(self.pairs)


def register_planes_globally(
    seen: Sequence[Plane] | PlaneArrays, known: Sequence[Plane] | PlaneArrays, sigmas: tuple[float, float]
) -> PlaneMatching | None:
    """Find the motion that explains the largest planes, with no more of a guess than "about where it was".

    Two pairs of planes that enclose the same angle give a rotation, three offsets a translation. Every motion is scored
    by the planes that find a partner, by the root of their area, less what it costs to move that far. The best, and the
    place where the body is expected, are worked out with all their pairs by least squares, and scored anew by what the
    planes have in common, less what would be seen through walls: halls look alike from both ends. Of those that this
    does not tell apart, the least is taken.

    Args:
        seen: planes in the frame of the body now.
        known: planes in the frame where the body is expected.
        sigmas: standard deviations of that expectation, m and rad, the same in all directions.

    Returns:
        None where fewer than three planes, in two directions at least, find partners.
    """
    mine, theirs = PlaneArrays.of(seen), PlaneArrays.of(known)
    if min(len(mine.normals), len(theirs.normals)) < 2:
        return None
    likely = _motions(mine, theirs, sigmas, upright=True)[:_MOTIONS]
    sight = LinesOfSight.between(mine.planes, mine.weights, theirs.planes)
    best, alike = -np.inf, _ALIKE * float(mine.weights.sum())
    tried: list[tuple[float, float, PlaneMatching]] = []
    for found in _worked_out([np.eye(4), *likely], mine, theirs, sigmas):
        price = negative_log_prior(found.known_T_seen, sigmas)
        score = _agreement(found.known_T_seen, mine, theirs, best - alike + price) - price
        if score > best - alike:
            score -= sight.blocked(found.known_T_seen)
        tried.append((score, price, found))
        best = max(best, score)
    equals = [one for one in tried if one[0] >= best - alike]
    least = min((price for _, price, _ in equals), default=0.0)
    cheap = (one for one in equals if one[1] <= least + 0.1)  # beyond, it is not the same a little off
    return max(cheap, key=lambda one: one[0], default=(0.0, 0.0, None))[2]


def places_anywhere(seen: Sequence[Plane], known: Sequence[Plane]) -> list[tuple[float, PlaneMatching]]:
    """Every place that pairs of planes propose, wherever in the map and however tipped, the best first.

    Each with the share of what is seen, by the root of area, that is known from there, less what would be seen through
    walls. As `register_planes_globally`, without an expectation.

    Args:
        seen: planes in the frame of the body.
        known: those of the map.
    """
    mine, theirs = PlaneArrays.of(seen), PlaneArrays.of(known)
    if min(len(mine.normals), len(theirs.normals)) < 3:
        return []
    origin = np.eye(4)  # in the middle of the map, from which all of it is about as far
    origin[:3, 3] = theirs.middles.mean(axis=0)
    centred = PlaneArrays.of([plane.transform(inverse(origin)) for plane in known])
    reach = float(np.linalg.norm(centred.middles, axis=1).max()) + 1.0
    anywhere = (reach, np.pi)
    likely = _motions(mine, centred, anywhere, upright=False)[: 2 * _MOTIONS]
    sight, total = LinesOfSight.between(mine.planes, mine.weights, centred.planes), float(mine.weights.sum())
    places: list[tuple[float, PlaneMatching]] = []
    for found in _worked_out(likely, mine, centred, anywhere):
        weight = _agreement(found.known_T_seen, mine, centred) - sight.blocked(found.known_T_seen)
        places.append((weight / total, replace(found, known_T_seen=origin @ found.known_T_seen)))
    return sorted(places, key=lambda one: -one[0])


def matched_under(known_T_seen: FloatArray, seen: PlaneArrays, known: PlaneArrays) -> int:
    """How many planes are in both under a motion (4, 4); pieces of one count once."""
    return _in_both(pairs_under(known_T_seen, seen, known))


def _in_both(pairs: Sequence[tuple[int, int]]) -> int:
    return min(len({i for i, _ in pairs}), len({j for _, j in pairs}))


def chance_of(matched: int, elsewhere: Sequence[int], n_planes: int) -> float:
    """With what probability another place, or another building, would have as many of the planes that are seen.

    Three planes fit some place in any building: three offsets tell a translation. What each other plane finds by chance
    the places say that were looked at and are not the one: as often as that, of as many places, the best would have as
    many (binomial test, Bonferroni; one plane of two is what a test knows beforehand, Laplace's rule).

    Args:
        matched: planes that are known at the place.
        elsewhere: the same at every other place that was looked at.
        n_planes: all that are seen.
    """
    others = np.maximum(np.array(elsewhere, dtype=np.int64) - 3, 0)
    spare, free = matched - 3, max(n_planes - 3, 0)
    share = min((others.sum() + 1.0) / (len(others) * free + 2.0), 1.0)
    as_many = 1.0 if spare <= 0 else float(bdtrc(spare - 1, free, share))
    return min((len(others) + 1) * as_many, 1.0)


def pairs_under(
    known_T_seen: FloatArray, seen: Sequence[Plane] | PlaneArrays, known: Sequence[Plane] | PlaneArrays
) -> tuple[tuple[int, int], ...]:
    """(seen, known) of the planes, of the largest of both, that are one under a motion (4, 4)."""
    mine, theirs = PlaneArrays.of(seen), PlaneArrays.of(known)
    return tuple((mine.order[i], theirs.order[j]) for i, j in _partners(known_T_seen, mine, theirs).tolist())


def _worked_out(
    motions: Sequence[FloatArray], mine: PlaneArrays, theirs: PlaneArrays, sigmas: tuple[float, float]
) -> list[PlaneMatching]:
    """Rough motions after least squares over the pairs they have, and those they have then, in order, each once."""
    fits: list[tuple[FloatArray, FloatArray]] = []
    for loose in _LOOSE:
        pairs = [_partners(motion, mine, theirs) for motion in motions]
        fits = [fit for fit in fit_pairs(motions, mine, theirs, pairs, sigmas, loose) if fit is not None]
        motions = [motion for motion, _ in fits]
    found: list[PlaneMatching] = []
    for motion, covariance in fits:
        if all(np.abs(motion - other.known_T_seen).max() >= 1e-3 for other in found):
            found.append(PlaneMatching(motion, covariance, pairs_under(motion, mine, theirs)))
    return found


def negative_log_prior(motion: FloatArray, sigmas: tuple[float, float]) -> float:
    """What a motion of this size costs: half its chi2 by the expectation while small, only the log of it far off.

    The third axes of both frames point up.

    Expectations fail: wheels slip, guesses are guesses, and what carries a sensor turns on its heel. But nobody turns
    it upside down, and a room so turned may have more planes in common with itself than it has seen from another place.

    Args:
        motion: shape (4, 4).
        sigmas: standard deviations of place and turn, m and rad.
    """
    turned = _tail((angle_of(motion) / sigmas[1]) ** 2)
    return float(_tilted(motion[2, 2])) + turned + _tail(motion[:3, 3] @ motion[:3, 3] / sigmas[0] ** 2)


def _tilted(cosines: Any) -> Any:
    """What it costs that upright axes enclose angles of these cosines: half the chi2."""
    return 0.5 * np.square(np.arccos(np.clip(cosines, -1.0, 1.0)) / _TILT_RAD)


def _tail(chi2: Any) -> Any:
    return _TAIL * np.log1p(0.5 * chi2 / _TAIL)


def _motions(mine: PlaneArrays, theirs: PlaneArrays, sigmas: tuple[float, float], *, upright: bool) -> list[FloatArray]:
    """Motions that pairs of planes propose, by their scores, the best first."""
    rotations = _rotations(mine, theirs, sigmas[1], upright=upright)
    scored = [motion for price, R in rotations for motion in _translations(R, price, mine, theirs, sigmas[0])]
    return [motion for _, motion in sorted(scored, key=lambda one: -one[0])]


def _rotations(
    mine: PlaneArrays, theirs: PlaneArrays, sigma_rad: float, *, upright: bool
) -> list[tuple[float, FloatArray]]:
    """What rotations cost, with those under which most directions agree, best first, none twice."""
    frames = _frames(mine.normals[:9], ordered=False)  # the largest planes make hypotheses
    others = _frames(theirs.normals, ordered=True)
    if not len(frames[0]) or not len(others[0]):
        return []
    furthest = min(max(_FAR * sigma_rad, 0.1), np.pi)
    rotations, traces = near_rotations(frames, others, _ANGLE, 1.0 + 2.0 * np.cos(furthest))
    turns = np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0))
    agree = directions_found(rotations, mine.normals, theirs.normals, mine.weights, np.cos(_ANGLE))
    prices = _tail((turns / sigma_rad) ** 2) + (_tilted(rotations[:, 2, 2]) if upright else 0.0)
    best_first = np.argsort(prices - agree, kind="stable")
    chosen = best_first[unlike(rotations[best_first], 1.0 + 2.0 * np.cos(_ANGLE), 40)]  # so many are looked at closer
    return list(zip(prices[chosen].tolist(), rotations[chosen], strict=True))


def near_rotations(
    mine: tuple[FloatArray, FloatArray], theirs: tuple[FloatArray, FloatArray], tolerance: float, least_trace: float
) -> tuple[FloatArray, FloatArray]:
    """Rotations (K, 3, 3), and their traces (K,), from frames (A, 3, 3) to others (B, 3, 3) with angles as large."""
    (frames, angles), (others, other_angles) = mine, theirs
    # products are summed one after another, the same bits on every machine: matmul leaves the order open
    traces = sum(frames[:, None, i, j] * others[:, i, j] for i in range(3) for j in range(3))
    a, b = np.nonzero((np.abs(angles[:, None] - other_angles) < tolerance) & (traces > least_trace))
    first, second, third = (others[b][:, :, None, k] * frames[a][:, None, :, k] for k in range(3))
    return first + second + third, np.asarray(traces)[a, b]


def _frames(normals: FloatArray, *, ordered: bool) -> tuple[FloatArray, FloatArray]:
    """Right-handed frames (K, 3, 3) of all pairs of normals that are not parallel, and their angles (K,)."""
    pairs = np.array(list(combinations(range(len(normals)), 2)), dtype=np.int64).reshape(-1, 2)
    if ordered:
        pairs = np.vstack((pairs, pairs[:, ::-1]))
    first, second = normals[pairs[:, 0]], normals[pairs[:, 1]]
    cosines = np.einsum("ki,ki->k", first, second)
    usable = np.abs(cosines) < 0.94  # 20 deg: closer ones define no rotation
    first, second, cosines = first[usable], second[usable], cosines[usable]
    across = np.cross(first, second)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    angles = np.arccos(np.clip(cosines, -1.0, 1.0)).astype(np.float64)
    return np.stack((first, across, np.cross(first, across)), axis=2).astype(np.float64), angles


def _translations(
    rotation: FloatArray, price: float, mine: PlaneArrays, theirs: PlaneArrays, sigma_m: float
) -> list[tuple[float, FloatArray]]:
    """The best motions with a rotation that costs so much, with their scores, from threes of pairs."""
    turned = mine.normals @ rotation.T
    i, j = np.ascontiguousarray(np.nonzero(turned @ theirs.normals.T > np.cos(_ANGLE)))
    if len(i) < 3:
        return []
    weights = np.minimum(mine.weights[i], theirs.weights[j])
    offsets, normals = theirs.distances[j] - mine.distances[i], theirs.normals[j]
    near = np.abs(offsets) < _FAR * sigma_m
    strongest = np.argsort(-np.where(near, weights, -1.0), kind="stable")[:26]  # 2600 threes of them at most
    strongest = strongest[near[strongest]]
    middles, reaches = theirs.middles[j] - (mine.middles @ rotation.T)[i], mine.reaches[i] + theirs.reaches[j] + _GAP
    shifts, found = best_shifts(
        i, normals, offsets, mine.weights, middles, reaches, strongest, _DISTANCE, sigma_m, _TAIL
    )
    results = []
    for shift, weight in zip(shifts, found.tolist(), strict=True):
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation, shift
        results.append((weight - price - _tail(shift @ shift / sigma_m**2), motion))
    return results


def _partners(motion: FloatArray, mine: PlaneArrays, theirs: PlaneArrays) -> np.ndarray:
    """(seen, known) of every plane seen with the known one nearest in offset that it is, outlines meeting, (K, 2)."""
    shapes = ((planes.frames, planes.bare, *planes.rings) for planes in (mine, theirs))
    return partners(np.ascontiguousarray(motion), *shapes, float(np.cos(_ANGLE)), _DISTANCE, _GAP)


def _agreement(motion: FloatArray, mine: PlaneArrays, theirs: PlaneArrays, needed: float = -np.inf) -> float:
    """How much of what is seen is known under a motion worked out: the root of the area in common, and how close.

    Within one standard deviation planes are as close as can be: noise must not tell two ends of a hall apart.
    Where that turns out to be less than what is needed, just so much less as is known by then.
    """
    turned = mine.normals @ motion[:3, :3].T
    angles = np.arccos(np.clip(turned @ theirs.normals.T, -1.0, 1.0)) / _FINE_ANGLE
    far = angles**2 + (_heights(motion, mine, theirs) / _FINE_DISTANCE) ** 2
    closeness = np.where(far < 9.0, 1.0 / np.maximum(far, 1.0), 0.0)
    most = closeness * np.minimum(mine.weights[:, None], theirs.weights)  # a wall has a pillar's face in common
    total = float(most.max(axis=1).sum())
    for i, plane in enumerate(mine.planes):  # the largest first
        if total < needed - 1e-9:
            break
        shared, order = 0.0, np.argsort(-most[i], kind="stable")
        for j in order.tolist():
            if most[i, j] <= shared:
                break  # outlines have all in common at most
            share = min(_common(plane, theirs.planes[j], motion), 1.0)
            shared = max(shared, float(np.sqrt(share) * most[i, j]))
        total -= float(most[i, order[0]]) - shared
    return total


def _heights(motion: FloatArray, mine: PlaneArrays, theirs: PlaneArrays) -> FloatArray:
    """How far planes seen lie from known ones under a motion, at the middle of the smaller of the two, (N, M), m.

    Not at the origin: there a tilt that is off shifts a plane by as much as it is away.
    """
    turned = mine.normals @ motion[:3, :3].T
    seen = (mine.middles @ motion[:3, :3].T + motion[:3, 3]) @ theirs.normals.T - theirs.distances
    known = (mine.distances + turned @ motion[:3, 3])[:, None] - turned @ theirs.middles.T
    return np.where(mine.weights[:, None] <= theirs.weights, seen, known)


def _common(seen: Plane, known: Plane, motion: FloatArray) -> float:
    """Common area of two outlines as a share of the smaller one."""
    if seen.outline is None or known.outline is None:
        return 0.0
    moved = valid(flatten(seen.outline, inverse(known.frame) @ motion @ seen.frame))
    least = min(moved.area, known.outline.area)
    return moved.intersection(known.outline).area / least if least > 0.0 else 0.0
