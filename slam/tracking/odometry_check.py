"""Odometry held against 3D scans: by their planes, and by all their returns where planes leave open what these may say.

Odometry may be a guess. Where the planes of two scans agree with it and say all that the returns could say, these are
not asked: laying a scan on those before costs more than all else about a keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.special import chdtri, logit

from factors._conventions import POSE3_TO_SP
from factors.association.observations import planes_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.laser_odometry.stalled_wheels import STANDING
from slam.frontend.odometry import Motion
from slam.geometry.frames import are_apart, inverse
from slam.map.state import EstimatorState
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.motion_from_planes import fit_pairs
from slam.registration.motion_prior import MotionPrior
from slam.registration.plane_registration import pairs_under, register_planes_globally
from slam.registration.relocalization import (
    are_one,
    displacement,
    information_of,
    is_poorly_known,
    local_map,
    planes_about,
    register_from_hypotheses,
    scan_of,
    sigmas_of,
    stated,
    where_expected,
)
from slam.registration.surface_registration import (
    WEAK_M,
    WEAK_PRIOR,
    WEAK_RAD,
    Alignment,
    Expected,
    align,
    most_information,
)
from slam.tracking.odometry_scale import SLIPS, free_axes
from spplanes import Plane
from spplanes._check import FloatArray

#: Planes say as much as all returns could where what they leave to be told apart is, in every direction, at most so
#: many times as wide, as a standard deviation. Between planes that hold a motion (1.1 to 1.4 in simulated buildings)
#: and those that leave a direction open to returns that do not (3 and more) there is little.
_AS_GOOD = 2.0
#: What a fit leaves out, whatever covariance it has, SP order.
_LEFT_OUT = stated(np.zeros((6, 6)))


class Check(NamedTuple):
    """What a 3D scan says of a motion that was measured."""

    against: bool
    """Whether it speaks against it."""
    place: FloatArray | None = None
    """Covariance of where the scan itself has the body, SP order, shape (6, 6); None: nowhere, or nobody asked."""
    off: FloatArray | None = None
    """How far from where the motion leads that is, SP order along the axes there, shape (6,); None: as for it."""
    known: FloatArray | None = None
    """Covariance of that as the fit has it, without what it leaves out, shape (6, 6); None: as for it."""
    odds: float | None = None
    """By how many nats what it sees is likelier if wheels slipped, see `_slip_odds`; None: it lies where the motion
    leads, or nobody asked."""

    def tells(self, motion: Motion, errors: FloatArray, significance: float) -> np.ndarray:
        """Which errors (K, 6) of a motion, SP order along the axes of its end, this scan would speak against, (K,)."""
        if self.place is None or not len(errors):
            return np.zeros(len(errors), dtype=bool)
        chi2 = np.einsum("ki,ki->k", errors, np.linalg.solve(self.place + motion.spatial, errors.T).T)
        return chi2 > chdtri(6, significance)


def check(
    keyframe: Keyframe,
    motion: Motion,
    otherwise: Motion,
    state: EstimatorState,
    *,
    significance: float,
    again: float,
    prior: MotionPrior,
) -> tuple[Check, Alignment | None]:
    """Whether what a 3D scan sees speaks against a motion that was measured, and how sharply it could.

    The scan is laid on what was seen before from where the motion leads; it speaks against the motion where it comes to
    rest further off than both covariances allow, and does not fit nearly as well where the motion holds it: along a
    corridor a scan slides to the next place that looks alike. Far from the true place it may rest anywhere: where more
    of what it sees contradicts than fits where the motion leads, it is looked for as if nobody had measured the motion,
    and speaks against it from a place that fits clearly better and is as far off; where nothing of it was seen before
    there is nothing to say. A motion as this body makes none is asked so in any case: odometry that begins anew leads
    to where a scan fits somehow. So is what may well be wrong as the step before was: wheels that slip or stand still
    do so for a while. While wheels stand, the planes of two scans are where they were.

    Args:
        keyframe, motion: what is seen, and what is known of its motion.
        otherwise: the motion had nobody measured it, as wide as a body may go of which nothing is known.
        state: the keyframes before, the landmarks as of the last refresh, and the graph.
        significance: probability that a true motion is spoken against.
        again: probability that wheels slip as they did the step before.
        prior: of that motion, by how steadily the body moves.

    Returns:
        What it says; and where it was laid, seen from where the motion leads, if it does not speak against that, which
        is yet further off than it states: what the scan says counts beside it then. None elsewhere.
    """
    scan = scan_of(keyframe)
    if is_poorly_known(motion) or scan is None:
        return Check(False), None
    share, doubted = max(SLIPS, again), again > SLIPS
    before, seen = (planes_of(one.observations) for one in (state.keyframes[-1], keyframe))
    if (fit := laid_by_planes(motion, before, seen)) is not None:
        by_planes = None if doubted else planes_confirm(motion, *fit, scan.elements, significance)
        by_planes = by_planes or _moved_while_standing(motion, *fit, significance)
        if by_planes is not None:
            return by_planes, None
    expected_T_world = where_expected(motion, state)
    known = local_map(state, expected_T_world)
    if known is None:
        return Check(False), None

    def is_off(found: Alignment) -> bool:
        return not _agree(motion, found.known_T_seen, _by_returns(found.information)[0], significance)

    @cache
    def held() -> Alignment:
        return align(scan, known, [np.eye(4)], Expected(np.eye(4), information_of(motion)))

    found, laid = align(scan, known, [np.eye(4)]), None
    rests = (None, None, None)
    if found.score > 0.0:
        believed, fitted = _by_returns(found.information)
        rests = believed, displacement(np.eye(4), found.known_T_seen), fitted
    odds = None
    if is_off(found):
        there = held()
        odds = _slip_odds(found, there, motion, prior)
        if is_off(there) or odds + logit(share) > 0.0:
            return Check(True, *rests), None
        found, rests = there, (_by_returns(there.information)[0] if there.score > 0.0 else None, None, None)
    elif rests[2] is not None and not _agree(motion, found.known_T_seen, rests[2], significance):
        laid = there if (there := held()).score > 0.0 else None
    b_T_a = inverse(motion.a_T_b)
    steady = _agree(motion, b_T_a @ prior.motion.a_T_b, prior.learnt().spatial, significance)
    if not doubted and steady:
        # a scan that slid away, as one does that is turned by half a right angle, meets nothing there that contradicts
        is_near = _agree(motion, found.known_T_seen, _LEFT_OUT, significance)
        if (found if is_near else held()).score >= 0.0:
            return Check(False, *rests, odds), laid
    matched = register_planes_globally(*planes_about(keyframe, state, expected_T_world), sigmas_of(otherwise))
    expected = Expected(b_T_a @ otherwise.a_T_b, information_of(otherwise))
    rival = register_from_hypotheses(scan, known, matched, expected, b_T_a)
    if is_off(rival):
        elsewhere = _slip_odds(rival, found, motion, prior)
        odds = elsewhere if odds is None else max(odds, elsewhere)
    against = bool(odds is not None and odds + logit(share) > 0.0)
    return Check(against, *rests, odds), None if against else laid


def _slip_odds(elsewhere: Alignment, there: Alignment, motion: Motion, prior: MotionPrior) -> float:
    """By how many nats what is seen is likelier where wheels slipped, and the scan lies elsewhere, than where they led.

    Where wheels slip the body may be anywhere that it could have gone: of so many places some fit what is seen by
    chance. Log odds are those of the scores, less by how much wider it is spread.
    """
    (place, _), axes = _by_returns(elsewhere.information), free_axes(motion)
    off = displacement(inverse(motion.a_T_b) @ prior.motion.a_T_b, elsewhere.known_T_seen)
    held = -0.5 * np.log(np.diag(motion.spatial + place))
    spread = float(np.sum((held - prior.log_density(off, place))[axes]))
    return elsewhere.log_odds(there) - spread


def laid_by_planes(
    motion: Motion, before: Sequence[Plane], seen: Sequence[Plane]
) -> tuple[FloatArray, FloatArray] | None:
    """Where the planes of a scan lie on those of the one before, either in the body's frame; None: most on none.

    The place as seen from where the motion leads, shape (4, 4), and its covariance, GTSAM order, (6, 6).
    """
    mine, theirs = (PlaneArrays.as_given(planes) for planes in (seen, before))
    pairs = np.array(pairs_under(motion.a_T_b, mine, theirs), dtype=np.int64).reshape(-1, 2)
    if not len(pairs) or not _most_paired(mine, pairs[:, 0]):
        return None
    [fit] = fit_pairs([motion.a_T_b], mine, theirs, [pairs], (WEAK_M, WEAK_RAD))
    return None if fit is None else (inverse(motion.a_T_b) @ fit[0], fit[1])


def planes_confirm(
    motion: Motion, place: FloatArray, covariance: FloatArray, elements: FloatArray, significance: float
) -> Check | None:
    """What the planes of two scans say, if they agree with a motion and leave nothing to other returns.

    What tells a wrong motion from a true one is how well it is known where the scan comes to rest, and how well the
    motion is. By planes the two together must be about as small, in every direction, as by returns at their best.

    Args:
        motion: what is known of the motion.
        place, covariance: where `laid_by_planes` has them.
        elements: surface elements of this scan, shape (N, 9).
        significance: probability that a true motion is not confirmed, which is None.
    """
    (by_planes, fitted), (at_best, _) = _believed(covariance), _by_returns(most_information(elements))
    apart = motion.spatial
    widest = np.max(eigh(by_planes + apart, at_best + apart, eigvals_only=True))
    if widest >= _AS_GOOD**2 or not _agree(motion, place, fitted, significance):
        return None
    return Check(False, by_planes, displacement(np.eye(4), place), fitted)


def _moved_while_standing(
    motion: Motion, place: FloatArray, covariance: FloatArray, significance: float
) -> Check | None:
    """What the planes of two scans say against wheels that stand, None: nothing; arguments as of `planes_confirm`.

    What a fit leaves out is alike in two scans of one place: while a body stands its planes stay where they are to
    their noise. In a bare corridor they tell that it turns and goes aside by a little, as a body does that drives on.
    """
    by_planes, fitted = _believed(covariance)
    stands = not are_apart(np.eye(4), motion.a_T_b, STANDING, STANDING)
    if not stands or _agree(motion, place, by_planes - _LEFT_OUT, significance):
        return None
    return Check(True, by_planes, displacement(np.eye(4), place), fitted)


def _most_paired(seen: PlaneArrays, paired: np.ndarray) -> bool:
    """Whether of the planes seen those of some indices are most, by the root of area, in every direction they look.

    Were it most of all of them, floor and one row of walls would speak for a motion along these, under which the walls
    across find no partner, but for one that has another before it.
    """
    all_of, these = (
        np.einsum("k,ki,kj->ij", seen.weights[which], seen.normals[which], seen.normals[which])
        for which in (slice(None), paired)
    )
    return bool(np.linalg.eigvalsh(these - 0.5 * all_of)[0] >= -1e-9 * np.trace(all_of))  # nothing: to rounding


def _agree(motion: Motion, place: FloatArray, covariance: FloatArray, significance: float) -> bool:
    """Whether a motion and a place as seen from where it leads (4, 4), SP covariance (6, 6), may be the same."""
    return are_one(np.eye(4), place, covariance + motion.spatial, significance)


def _by_returns(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances (6, 6), SP order, of where returns of that information lay a scan: as believed, as the fit has it."""
    return _believed(np.linalg.inv(information + WEAK_PRIOR).astype(np.float64))


def _believed(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The covariance of a fit, GTSAM order, in SP order (6, 6): as believed, and as the fit has it."""
    return stated(covariance), covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
