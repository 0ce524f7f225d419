"""Shared landmarks: which planes of which missions are one, by the overlaps first and by the joint state then."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam.config import SlamConfig
from slam.geometry.frames import inverse
from slam.joining.alignment import facing_pairs
from slam.joining.mission import Mission
from slam.joining.overlap import Comparison
from slam.joining.solution import JointSolution
from slam.joining.ties import Place, Tie
from spplanes._check import FloatArray


class Classes:
    """Landmarks that are one plane, as they are found: of one mission never two, for that told them apart itself."""

    def __init__(self) -> None:
        self._of: dict[Place, set[Place]] = {}

    def add(self, tie: Tie) -> bool:
        """Make two landmarks one; whether that could be."""
        first, second = (self._of.get(place, {place}) for place in (tie.first, tie.second))
        both = first | second
        if first is not second and len({place.mission for place in both}) < len(both):
            return False
        for place in both:
            self._of[place] = both
        return True

    def are_one(self, tie: Tie) -> bool:
        """Whether two landmarks are one already."""
        return tie.second in self._of.get(tie.first, ())

    def all(self, places: Iterable[Place]) -> tuple[tuple[Place, ...], ...]:
        """Every landmark in its class, the classes in the order of their first ones."""
        classes = {tuple(sorted(self._of.get(place, {place}))) for place in places}
        return tuple(sorted(classes))


def classes_of(ties: Iterable[Tie], missions: Sequence[Mission]) -> tuple[tuple[Place, ...], ...]:
    """Every plane of every map in its class."""
    classes = Classes()
    for tie in ties:
        classes.add(tie)
    return classes.all(Place(number, one.id) for number, mission in enumerate(missions) for one in mission.planes)


def ties_of(overlaps: Iterable[Comparison], missions: Sequence[Mission]) -> list[Tie]:
    """The ties of overlaps, the strongest overlaps first; what would make two landmarks of one mission one is not."""
    numbers = {one.name: number for number, one in enumerate(missions)}
    classes, ties = Classes(), []
    for one in sorted(overlaps, key=lambda one: -one.strength):
        a, b = numbers[one.first], numbers[one.second]
        for i, j in one.alignment.pairs if one.alignment is not None else ():
            tie = Tie(Place(a, missions[a].planes[i].id), Place(b, missions[b].planes[j].id))
            if classes.add(tie):
                ties.append(tie)
    return ties


def candidates(
    missions: Sequence[Mission], common_T_mission: Mapping[int, FloatArray], ties: Sequence[Tie], config: SlamConfig
) -> list[Tie]:
    """Landmarks that may turn out to be one once all missions are solved together: they lie over each other."""
    known, found = set(ties), []
    for a, mine in enumerate(missions):
        for b in range(a + 1, len(missions)):
            a_T_b = inverse(common_T_mission[a]) @ common_T_mission[b]
            for i, j in facing_pairs(mine, missions[b], a_T_b, config.association):
                first, second = mine.planes[i], missions[b].planes[j]
                apart = abs((inverse(first.plane.frame) @ a_T_b @ second.plane.frame)[2, 3])
                tie = Tie(Place(a, first.id), Place(b, second.id))
                if apart <= config.loops.tied_m and tie not in known:
                    found.append(tie)
    return found


def found_to_be_one(solution: JointSolution, maybe: Sequence[Tie], config: SlamConfig) -> list[Tie]:
    """Of landmarks that may be one those that are, by chi2 (3 dof) with the joint covariance of all; best first."""
    classes = Classes()
    for tie in solution.ties:
        classes.add(tie)
    asked = [tie for tie in maybe if not classes.are_one(tie)]
    limit = float(chi2_distribution.isf(config.association.significance, 3))
    ranked = []
    for tie, (difference, covariance) in zip(asked, solution.differences(asked), strict=True):
        chi2 = float(difference @ np.linalg.solve(covariance, difference))
        if chi2 <= limit:
            ranked.append((chi2, tie))
    return [tie for _, tie in sorted(ranked) if classes.add(tie)]


def shared_by(count: int, ties: Iterable[Tie]) -> dict[int, tuple[int, ...]]:
    """By mission, of so many, the landmarks that ties are about."""
    shared: dict[int, set[int]] = {number: set() for number in range(count)}
    for tie in ties:
        for place in (tie.first, tie.second):
            shared[place.mission].add(place.landmark)
    return {number: tuple(sorted(landmarks)) for number, landmarks in shared.items()}
