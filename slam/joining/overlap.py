"""Overlap of two missions: proposed by the constellation of their walls, verified by all planes and free space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np
import shapely

from factors._conventions import SP_TO_POSE3
from slam.config import SlamConfig
from slam.diagnostics.evidence.surfaces import agreement
from slam.diagnostics.verdict import at_least
from slam.diagnostics.views import View, compare
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.frontend.odometry import spatial_covariance
from slam.geometry.frames import inverse, lift
from slam.joining.alignment import LEVEL_SIGMA_M, LEVEL_SIGMA_RAD, Alignment, align, common_planes, facing_pairs
from slam.joining.mission import Look, Mission
from slam.registration.place_recognition import MAX_LEAN, Wall, match_constellations
from spplanes._check import FloatArray, as_transform

Verdict = Literal["joined", "refused", "ambiguous", "unobservable", "not seen", "revoked"]

#: Keyframes of two missions this near each other are compared, m, and of every one so many at most.
_REACH_M, _PARTNERS = 4.0, 3
#: Standard deviations of a guess that a user gives: m and rad.
GUESS_SIGMA_M, GUESS_SIGMA_RAD = 0.5, 0.1


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two missions compared, and what came of it."""

    first: str
    """Name of one mission, a."""
    second: str
    """Name of the other, b."""
    verdict: Verdict
    """joined: they overlap; refused: they look as if they did, but planes or free space speak against it; ambiguous,
    unobservable: as the constellations say; not seen: nothing in common; revoked: refused by what all missions say
    together."""
    reason: str
    alignment: Alignment | None = None
    """The motion a_T_b with the planes that are one."""
    evidence: float = float("nan")
    """Log of how much better the walls agree than by chance."""
    looks: int = 0
    """Looks of one mission at surfaces of the other: confirmed, or gone through."""
    through: int = 0
    """Those that went through."""
    moved: tuple[tuple[int, int], ...] = ()
    """Landmarks (of a, of b) that face each other where they should be one, and are not: gone, moved, or new."""

    @property
    def strength(self) -> float:
        """What overlaps are ordered by: the evidence; where a guess was given the number of planes that bear it out."""
        planes = 0 if self.alignment is None else len(self.alignment.pairs)
        return float(planes) if np.isnan(self.evidence) else self.evidence

    def to_dict(self) -> dict[str, Any]:
        """For joins.json."""
        known = self.alignment
        document: dict[str, Any] = {
            "missions": [self.first, self.second],
            "verdict": self.verdict,
            "reason": self.reason,
            "evidence": None if np.isnan(self.evidence) else self.evidence,
            "looks": self.looks,
            "looks_through": self.through,
            "not_one": [list(pair) for pair in self.moved],
        }
        if known is not None:
            document |= {
                "motion": known.a_T_b.tolist(),
                "covariance": known.covariance.tolist(),
                "common_planes": len(known.pairs),
                "chi2": known.chi2,
                "dof": known.n_dof,
            }
        return document


def compare_missions(
    a: Mission, b: Mission, config: SlamConfig, *, significance: float, guess: FloatArray | None = None
) -> Comparison:
    """Whether and how two missions overlap.

    1. The largest set of walls that they share under one motion in the plane, unless a guess is given.
    2. All planes that are one under it, at the height at which most are; the motion by all of them; those that fit the
       others least are let go until the rest agree (chi2). What faces each other and is not one is told.
    3. Free space: what keyframes of one saw, those of the other must not see through, more than people and doors do.

    Args:
        a, b: the missions.
        config: association and loop closure have the numbers.
        significance: probability of joining two that do not overlap, in (0, 0.5).
        guess: a_T_b, shape (4, 4), known to `GUESS_SIGMA_M` and `GUESS_SIGMA_RAD`; None: nothing is known.

    References:
        Weingarten, Gruener, Siegwart, ICRA 2004, for the planes' covariance that every test here leans on.
    """
    proposed = _proposed(a, b, significance, guess)
    if isinstance(proposed, Comparison):
        return proposed
    hypothesis, covariance, evidence = proposed
    found = _verified(a, b, hypothesis, covariance, config)
    if found is None:
        reason = f"fewer than {config.loops.min_walls} planes agree when all are compared"
        return Comparison(a.name, b.name, "refused", reason, evidence=evidence)
    looks, through = free_space(a, b, found.a_T_b)
    one = Comparison(a.name, b.name, "refused", "", found, evidence, looks, through, _apart(a, b, found, config))
    if looks and at_least(through, looks, NOVEL_SHARE) < significance:
        return replace(one, reason=f"{through} of {looks} looks of one mission go through surfaces that the other saw")
    if looks and 2 * through >= looks:
        return replace(one, reason=f"{through} of {looks} looks go through surfaces")
    reason = f"{len(found.pairs)} planes are one (chi2 {found.chi2:.1f} of {found.n_dof} dof)"
    return replace(one, verdict="joined", reason=reason)


def _proposed(
    a: Mission, b: Mission, significance: float, guess: FloatArray | None
) -> tuple[FloatArray, FloatArray, float] | Comparison:
    """A motion a_T_b to verify with its covariance, GTSAM order, and the evidence for it; or why there is none."""
    if guess is not None:
        sigmas = np.array([LEVEL_SIGMA_RAD, LEVEL_SIGMA_RAD, GUESS_SIGMA_RAD, *[GUESS_SIGMA_M] * 3])
        return as_transform("guess", guess), np.diag(sigmas**2), float("nan")
    match = match_constellations(walls_of(b), walls_of(a), significance=significance)
    if match is None:
        return Comparison(a.name, b.name, "not seen", "nothing in common was found")
    if match.verdict != "closure":
        but = "and about as well elsewhere" if match.verdict == "ambiguous" else "but leave a direction open"
        reason = f"{len(match.pairs)} walls agree, {but}"
        return Comparison(a.name, b.name, match.verdict, reason, evidence=match.evidence)
    level = LEVEL_SIGMA_M, LEVEL_SIGMA_RAD, LEVEL_SIGMA_RAD
    covariance = spatial_covariance(match.covariance, match.b_T_a, level)[np.ix_(SP_TO_POSE3, SP_TO_POSE3)]
    return match.b_T_a, covariance, match.evidence


def walls_of(mission: Mission) -> list[Wall]:
    """The upright planes of a mission as walls in its frame."""
    return [
        Wall.from_plane(
            plane.plane.normal,
            plane.plane.d,
            plane.plane.hesse_covariance,
            lift(shapely.get_coordinates(plane.seen), plane.plane.frame),
        )
        for plane in mission.planes
        if abs(plane.plane.normal[2]) < MAX_LEAN
    ]


def free_space(a: Mission, b: Mission, a_T_b: FloatArray) -> tuple[int, int]:
    """Looks of keyframes of one mission at surfaces that near ones of the other saw, and those that go through."""
    looks = through = 0
    for mine, theirs in _near_looks(a.looks, b.looks, a_T_b):
        for here, there, here_T_there in (
            (mine, theirs, inverse(mine.mission_T_body) @ a_T_b @ theirs.mission_T_body),
            (theirs, mine, inverse(a_T_b @ theirs.mission_T_body) @ mine.mission_T_body),
        ):
            confirmed, gone = _held_against(here, there, here_T_there)
            looks, through = looks + confirmed + gone, through + gone
    return looks, through


def _held_against(here: Look, there: Look, here_T_there: FloatArray) -> tuple[int, int]:
    """How many surfaces of one look another one confirms, and how many it sees through."""
    lasers, planes = (0, 0), (0, 0)
    if here.returns is not None and there.returns is not None and len(here.returns) and len(there.returns):
        lasers = compare(View.of(here.returns), View.of(there.returns), here_T_there)
    if here.planes and there.planes:
        planes = agreement(here.planes, there.planes, here_T_there, here.body_T_sensor)
    return lasers[0] + planes[0], lasers[1] + planes[1]


def _near_looks(mine: Sequence[Look], theirs: Sequence[Look], a_T_b: FloatArray) -> list[tuple[Look, Look]]:
    if not mine or not theirs:
        return []
    here = np.array([one.mission_T_body[:3, 3] for one in mine])
    there = lift(np.array([one.mission_T_body[:3, 3] for one in theirs]), a_T_b)
    apart = np.linalg.norm(here[:, None] - there[None], axis=2)
    pairs = []
    for i, row in enumerate(apart):
        nearest = np.argsort(row, kind="stable")[:_PARTNERS]
        pairs += [(mine[i], theirs[j]) for j in nearest.tolist() if row[j] <= _REACH_M]
    return pairs


def _verified(
    a: Mission, b: Mission, hypothesis: FloatArray, covariance: FloatArray, config: SlamConfig
) -> Alignment | None:
    """The motion by all common planes, at the height at which most planes are one; None where too few agree."""
    tried = []
    for height in _heights(a, b, hypothesis, config):
        raised = hypothesis.copy()
        raised[2, 3] = height
        tried.append(_settled(a, b, raised, covariance, config))
    return max((one for one in tried if one is not None), key=lambda one: len(one.pairs), default=None)


def _settled(
    a: Mission, b: Mission, hypothesis: FloatArray, covariance: FloatArray, config: SlamConfig
) -> Alignment | None:
    """Twice: planes that are one under the motion, the motion by them, less those that the others speak against."""
    found: Alignment | None = None
    for _ in range(2):
        pairs = common_planes(a, b, hypothesis, covariance, config.association)
        while True:
            if len(pairs) < config.loops.min_walls:
                return None
            found = align(a, b, pairs, hypothesis)
            if found.fits(config.association.significance):
                break
            del pairs[found.worst]
        hypothesis, covariance = found.a_T_b, found.covariance
    return found


def _heights(a: Mission, b: Mission, hypothesis: FloatArray, config: SlamConfig) -> list[float]:
    """Heights of b over a to try: none, and those that lay a level plane of b on one of a."""
    flat = [[plane for plane in m.planes if abs(plane.plane.normal[2]) > 1.0 - MAX_LEAN] for m in (a, b)]
    heights = [0.0]
    for mine, other in product(*flat):
        over = float(mine.plane.centre[2] - other.plane.centre[2])
        is_new = all(abs(over - known) > config.loops.tied_m for known in heights)
        if is_new and mine.plane.normal[2] * other.plane.normal[2] > 0.0:
            heights.append(over)
    return heights


def _apart(a: Mission, b: Mission, found: Alignment, config: SlamConfig) -> tuple[tuple[int, int], ...]:
    """Landmarks that lie over each other, centimetres apart, and are not one: what has moved between the missions."""
    of_a, of_b = ({pair[side] for pair in found.pairs} for side in (0, 1))
    return tuple(
        (a.planes[i].id, b.planes[j].id)
        for i, j, apart in facing_pairs(a, b, found.a_T_b, config.association)
        if i not in of_a and j not in of_b and apart < config.loops.tied_m
    )
