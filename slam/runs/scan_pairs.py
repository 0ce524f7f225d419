"""Two 3D scans: where one is in the frame of the other, whatever is known of that, and the pose refined by both.

Planes propose places anywhere, all returns decide between them. From the likeliest a run of two keyframes refines the
pose, by the planes and by what the returns on none of them add.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from factors.association.observations import PlaneObservation, planes_of
from slam.config import SlamConfig
from slam.diagnostics.evidence.registration import CloudMatch
from slam.diagnostics.views import ScanView, compare
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from slam.planeslam import PlaneSlam
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.plane_registration import matched_under, places_anywhere, register_planes_globally
from slam.registration.relocalization import scan_of
from slam.registration.surface_registration import WEAK_PRIOR, Expected, LocalMap, Tried, align
from spplanes._check import FloatArray

#: Places that planes propose are laid on by all returns, the best so many of them.
_PROPOSED = 32
#: Headings at which a scan is laid on where nothing but its returns may tell one: 45 deg apart, as far as a descent by
#: surface elements reaches to both sides.
_HEADINGS = 8
#: What a guess may be off, m and rad, for planes to look around it: a third of a room, and of a right angle.
_GUESS_M, _GUESS_RAD = 1.0, 0.5
#: What a place by all returns may be off when planes refine it, m and rad: wide for a run (`is_poorly_known`), which
#: then asks planes and returns again. Two places nearer than that are one: both would be refined to the same.
ABOUT_M, ABOUT_RAD = 0.3, 0.15


class Rival(NamedTuple):
    """Another place (4, 4) that a cloud may be at; its probability is by how the returns fit there."""

    a_T_b: FloatArray
    probability: float


class Place(NamedTuple):
    """Where a scan most likely is, (4, 4), other places, the likeliest first, and what planes and lines of sight say.

    The overlap is the share of the surface elements of B that lie on a surface of A.
    """

    a_T_b: FloatArray
    overlap: float
    rivals: tuple[Rival, ...]
    match: CloudMatch


def find_place(a: Keyframe, b: Keyframe, guess: FloatArray | None = None) -> Place | None:
    """Where a 3D scan is in the frame of another one; a guess is one hypothesis among others.

    Planes propose places anywhere, and about the guess; beside them are the guess, that nothing moved, and turns on the
    spot. The returns of both scans decide (`slam.registration.surface_registration.align`). None: one of them has no
    surface elements.
    """
    scan, known = scan_of(b), scan_of(a)
    if scan is None or known is None:
        return None
    theirs, mine = PlaneArrays.of(planes_of(a.observations)), PlaneArrays.of(planes_of(b.observations))
    anywhere = Expected(np.eye(4), WEAK_PRIOR)  # but upright: nobody carries a sensor upside down
    found = align(scan, LocalMap([(np.eye(4), known)]), _hypotheses(a, b, guess), anywhere)
    ranked: list[Tried] = []  # the places at which the scan came to rest, the likeliest first, none twice
    for one in found.tried:
        if not any(are_near(one.known_T_seen, other.known_T_seen) for other in ranked):
            ranked.append(one)
    chances = np.exp([one.log_likelihood - ranked[0].log_likelihood for one in ranked])
    rivals = [Rival(one.known_T_seen, float(p)) for one, p in zip(ranked, chances / chances.sum(), strict=True)][1:]
    matched = [matched_under(one.known_T_seen, mine, theirs) for one in ranked]
    a_T_b = found.known_T_seen
    from_a, from_b = ScanView(known, np.array([0.0, 0.0, 1.0])), ScanView(scan, a_T_b[2, :3])
    looks = (compare(from_a, from_b, a_T_b), compare(from_b, from_a, inverse(a_T_b)))
    wrong = sum(rival.probability for rival in rivals)
    match = CloudMatch(len(mine.normals), matched[0], tuple(matched[1:]), looks, wrong)
    return Place(a_T_b, found.share, tuple(rivals), match)


def _hypotheses(a: Keyframe, b: Keyframe, guess: FloatArray | None) -> list[FloatArray]:
    seen, known = planes_of(b.observations), planes_of(a.observations)
    places = [one.known_T_seen for _, one in places_anywhere(seen, known)[:_PROPOSED]]
    guesses = [] if guess is None else [guess]
    for start in (np.eye(4), *guesses):
        there = [plane.transform(inverse(start)) for plane in known]
        about = register_planes_globally(seen, there, (_GUESS_M, _GUESS_RAD))
        places += [] if about is None else [start @ about.known_T_seen]
    turns = [planar_transform(0.0, 0.0, turn) for turn in 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS]
    return [*places, *turns, *guesses]


def are_near(place: FloatArray, other: FloatArray) -> bool:
    """Whether two places (4, 4) would be refined to the same."""
    off = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(place) @ other))
    return bool(np.linalg.norm(off[3:]) < ABOUT_M and np.linalg.norm(off[:3]) < ABOUT_RAD)


class Refined(NamedTuple):
    """The pose of a scan in the frame of another one's body, as a run of the two has it."""

    a_T_b: FloatArray
    """Shape (4, 4)."""
    covariance: FloatArray
    """Shape (6, 6), SP order along b's axes, scaled by the chi2 of the planes."""
    n_planes: int
    """Those that both scans have."""
    nis_per_dof: float
    """Their chi2 by the noise assumed, per degree of freedom; NaN: too few planes to tell."""
    run: PlaneSlam


def refined(a: Keyframe, b: Keyframe, place: Place) -> Refined | None:
    """The pose of b in the frame of a, about where it was found; None: no plane is in both.

    Of K planes 3 K - 6 degrees of freedom are left beside the pose. By so few the noise is known with an error of its
    own: that of the pose has a variance larger than the estimate by dof / (dof - 2) (Student's t).
    """
    slam = _run_of_two(a, b, place)
    chi2 = _chi2_of_pairs(slam)
    if not chi2:
        return None
    first, second = slam.trajectory.poses
    nis, spare = float("nan"), 3 * len(chi2) - 6
    covariance = slam.marginal_covariance(gtsam.symbol("x", 1))[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    if spare > 2:
        nis = float(sum(chi2)) / spare
        covariance = covariance * nis * spare / (spare - 2)
    return Refined(inverse(first) @ second, covariance, len(chi2), nis, slam)


def _run_of_two(a: Keyframe, b: Keyframe, place: Place) -> PlaneSlam:
    """The run of the two clouds, the second about where it was found."""
    slam = PlaneSlam(SlamConfig())
    slam.add_keyframe(replace(a, stamp_ns=0, places=()))
    about = np.diag(np.repeat([ABOUT_M, ABOUT_RAD], 3) ** 2)
    motion = Motion(place.a_T_b, about, (ABOUT_M, ABOUT_RAD, ABOUT_RAD))
    slam.add_keyframe(replace(b, stamp_ns=1, motion=motion, places=()))
    return slam


def _chi2_of_pairs(slam: PlaneSlam) -> list[float]:
    """Squared Mahalanobis distances of the planes in both clouds, as measured, at the pose found: 3 dof each.

    Planes that come to face each other have none, and are in both no more.
    """
    first, second = slam.trajectory.poses
    found = []
    for landmark in slam.landmarks:
        numbers = {sighting.keyframe: sighting.observation for sighting in landmark.sightings}
        if len(numbers) == 2:
            pair = [slam.keyframes[keyframe].observations[numbers[keyframe]] for keyframe in (0, 1)]
            planes = [one.plane for one in pair if isinstance(one, PlaneObservation)]
            found.append(planes[0].mahalanobis(planes[1].transform(inverse(first) @ second)))
    return [chi2 for chi2 in found if np.isfinite(chi2)]
