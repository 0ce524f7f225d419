"""Places of one 3D scan in another: hypotheses from anywhere, laid on by all returns, ranked by how well they fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from slam.diagnostics.evidence.registration import CloudMatch
from slam.diagnostics.views.comparing import compare
from slam.diagnostics.views.scans import ScanView
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import planes_of
from slam.geometry.frames import inverse, planar_transform
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.plane_registration import match_planes_widely, pairs_under, places_anywhere
from slam.registration.relocalization import SILENT, scan_of
from slam.registration.surface_registration import Alignment, Expected, LocalMap, Tried, align
from spplanes._check import FloatArray

#: Places that planes propose are laid on by all returns, the best so many of them.
_PROPOSED = 32
#: Headings at which a scan is laid on where nothing but its returns may tell one: 45 deg apart, as far as a descent by
#: surface elements reaches to both sides.
_HEADINGS = 8
#: What a guess may be off, m and rad, for planes to look around it: a third of a room, and of a right angle.
_GUESS_M, _GUESS_RAD = 1.0, 0.5
#: What a place by all returns may be off when planes refine it, m and rad: wide for a run (`is_wide`), which then asks
#: planes and returns again. Two places nearer than that are one: both would be refined to the same.
ABOUT_M, ABOUT_RAD = 0.3, 0.15


class Rival(NamedTuple):
    """Another place that a cloud may be at."""

    a_T_b: FloatArray
    """Shape (4, 4)."""
    probability: float
    """Of all places that were looked at, by how well the returns fit there."""


class Place(NamedTuple):
    """Where a scan most likely is, and what speaks for and against it."""

    a_T_b: FloatArray
    """Shape (4, 4)."""
    overlap: float
    """Share of the surface elements of B that lie on a surface of A."""
    rivals: tuple[Rival, ...]
    """Other places, the likeliest first."""
    match: CloudMatch
    """What planes and lines of sight say."""


def find_place(a: Keyframe, b: Keyframe, guess: FloatArray | None = None) -> Place | None:
    """Where a 3D scan is in the frame of another one; a guess is one hypothesis among others.

    Planes propose places anywhere, and about the guess; beside them are the guess, that nothing moved, and turns on the
    spot. The returns of both scans decide (`slam.registration.surface_registration.align`).

    Returns:
        None where one of them has no surface elements.
    """
    scan, known = scan_of(b), scan_of(a)
    if scan is None or known is None:
        return None
    theirs, mine = PlaneArrays.of(planes_of(a.observations)), PlaneArrays.of(planes_of(b.observations))
    anywhere = Expected(np.eye(4), SILENT)  # but upright: nobody carries a sensor upside down
    found = align(scan, LocalMap([(np.eye(4), known)]), _hypotheses(a, b, guess), anywhere)
    ranked = _distinct(found)
    chances = np.exp([one.log_likelihood - ranked[0].log_likelihood for one in ranked])
    rivals = [Rival(one.known_T_seen, float(p)) for one, p in zip(ranked, chances / chances.sum(), strict=True)][1:]
    matched = [_one_to_one(pairs_under(one.known_T_seen, mine, theirs)) for one in ranked]
    up = np.array([0.0, 0.0, 1.0])
    a_T_b = found.known_T_seen
    from_a, from_b = ScanView(known, up), ScanView(scan, a_T_b[2, :3])
    looks = (compare(from_a, from_b, a_T_b), compare(from_b, from_a, inverse(a_T_b)))
    wrong = sum(one.probability for one in rivals)
    match = CloudMatch(len(mine.normals), matched[0], tuple(matched[1:]), looks, wrong)
    return Place(a_T_b, found.share, tuple(rivals), match)


def _hypotheses(a: Keyframe, b: Keyframe, guess: FloatArray | None) -> list[FloatArray]:
    seen, known = planes_of(b.observations), planes_of(a.observations)
    places = [one.known_T_seen for _, one in places_anywhere(seen, known)[:_PROPOSED]]
    for start in (np.eye(4), guess):
        if start is None:
            continue
        about = match_planes_widely(seen, [plane.transform(inverse(start)) for plane in known], (_GUESS_M, _GUESS_RAD))
        places += [] if about is None else [start @ about.known_T_seen]
    turns = [planar_transform(0.0, 0.0, turn) for turn in 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS]
    return [*places, *turns, *([] if guess is None else [guess])]


def _distinct(found: Alignment) -> list[Tried]:
    """The places at which a scan came to rest, the likeliest first, none twice."""
    kept: list[Tried] = []
    for one in found.tried:
        if not any(_are_one(one.known_T_seen, other.known_T_seen) for other in kept):
            kept.append(one)
    return kept


def _are_one(place: FloatArray, other: FloatArray) -> bool:
    off = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(place) @ other))
    return bool(np.linalg.norm(off[3:]) < ABOUT_M and np.linalg.norm(off[:3]) < ABOUT_RAD)


def _one_to_one(pairs: Sequence[tuple[int, int]]) -> int:
    """How many planes are in both: pieces of one plane count once."""
    return min(len({i for i, _ in pairs}), len({j for _, j in pairs}))
