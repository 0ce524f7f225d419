"""Joining finished missions: pairs compared, overlaps that agree chosen, every component solved as one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from slam.config import SlamConfig
from slam.geometry.frames import inverse
from slam.joining.alignment import facing_pairs
from slam.joining.consistency import Component, components_of, consistent
from slam.joining.joined_map import JoinedComponent, JoinedMap
from slam.joining.mission import FinishedMission, Mission
from slam.joining.overlap import Comparison, compare_missions
from slam.joining.solution import JoinError, JointSolution, Place, Tie
from spplanes._check import FloatArray

#: Probability that missions are joined of which not all overlap.
SIGNIFICANCE = 1e-3
#: So often is looked for planes that turn out to be one in the joint state.
_LOOKS = 3

Progress = Callable[[int, int], None]
Guesses = Mapping[tuple[str, str], FloatArray]


def join(
    runs: Sequence[Path | str | FinishedMission],
    *,
    config: SlamConfig | None = None,
    significance: float = SIGNIFICANCE,
    guesses: Guesses | None = None,
    strict: bool = False,
    progress: Progress | None = None,
) -> JoinedMap:
    """One map of many finished missions, wherever each began.

    1. Every two missions are compared (`slam.joining.overlap.compare_missions`).
    2. Overlaps that contradict others round a loop are taken back.
    3. Each component is solved as one, exactly: missions are condensed onto what they share, joined, back-substituted,
       and linearised anew until nothing moves. An overlap that the whole speaks against is taken back, and the
       component made anew.
    4. Planes that are one in the joint state become one.

    Args:
        runs: folders of finished runs, or missions that are open already.
        config: association and loop closure have the numbers; None: the defaults.
        significance: probability that any two are joined that do not overlap; each pair has its share.
        guesses: by (name, name) where the second mission's frame is in the first one's, shape (4, 4); names are those
            of the folders.
        strict: a run that cannot be used ends it; otherwise it is left out and named.
        progress: is told how many pairs are compared, and how many there are.

    Raises:
        ValueError: fewer than two runs, two of one name, a guess for none of them, a significance that is none; a run
            that cannot be used where `strict`, or none that can.
        JoinError: the graph of a mission that is alone does not come to rest.
    """
    if not 0.0 < significance < 0.5:
        raise ValueError(f"significance: expected a probability in (0, 0.5), got {significance}")
    if len(runs) < 2:
        raise ValueError(f"runs: expected at least two, got {len(runs)}")
    missions, left_out, folders = _opened(runs, strict=strict)
    config = config or SlamConfig()
    comparisons = _compared(missions, config, significance, guesses or {}, progress)
    return replace(joined_by(missions, comparisons, config, left_out), folders=folders)


def joined_by(
    missions: Mapping[str, FinishedMission],
    comparisons: Sequence[Comparison],
    config: SlamConfig,
    left_out: Mapping[str, str],
) -> JoinedMap:
    """What `join` does once all pairs of missions are compared, but for those `left_out`, by name with the reason."""
    comparisons = consistent(comparisons, config.association.new_significance)
    while True:
        solved = [_solved(component, missions, config) for component in components_of(list(missions), comparisons)]
        taken_back = [one for one in solved if isinstance(one, Comparison)]
        if not taken_back:
            made = tuple(one for one in solved if isinstance(one, JoinedComponent))
            return JoinedMap(made, tuple(comparisons), left_out)
        revoked = {(one.first, one.second): one for one in taken_back}
        comparisons = [revoked.get((comparison.first, comparison.second), comparison) for comparison in comparisons]


def names_of(runs: Sequence[Path | str]) -> list[str]:
    """A name for every run, or log: its folder's or file's, with as much of the path as tells it from the others.

    ValueError: one run is given twice.
    """
    paths = [Path(run).resolve() for run in runs]
    twice = [path for path in paths if paths.count(path) > 1]
    if twice:
        raise ValueError(f"runs: expected different ones, got {twice[0]} twice")
    bare = [path.with_name(path.name.removesuffix(".gz")) if path.is_file() else path for path in paths]
    parts = [(short.with_suffix("") if path.is_file() else path).parts for path, short in zip(paths, bare, strict=True)]
    for depth in range(1, max(map(len, parts), default=0) + 1):
        names = ["-".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(number) for number in range(len(paths))]


def _opened(
    runs: Sequence[Path | str | FinishedMission], *, strict: bool
) -> tuple[dict[str, FinishedMission], dict[str, str], dict[str, str]]:
    """Missions by name; those that cannot be used, and why; and the folders of those that came from one."""
    paths = [run for run in runs if not isinstance(run, FinishedMission)]
    names = iter(names_of(paths))
    missions: dict[str, FinishedMission] = {}
    left_out: dict[str, str] = {}
    folders: dict[str, str] = {}
    for run in runs:
        name = run.mission.name if isinstance(run, FinishedMission) else next(names)
        if name in missions:
            raise ValueError(f"runs: expected a name of its own for each, got two {name!r}")
        try:
            if isinstance(run, FinishedMission):
                missions[name] = run
            else:
                missions[name] = FinishedMission.open(run, name)
                folders[name] = str(Path(run).resolve())
        except (ValueError, OSError) as error:
            if strict:
                raise
            left_out[name] = " ".join(str(error).split())
    if not missions:
        told = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ValueError(f"runs: expected finished runs, got none that can be used ({told})")
    return missions, left_out, folders


def _compared(
    missions: Mapping[str, FinishedMission],
    config: SlamConfig,
    significance: float,
    guesses: Guesses,
    progress: Progress | None,
) -> list[Comparison]:
    pairs = list(combinations(missions, 2))
    unknown = [pair for pair in guesses if pair not in pairs and pair[::-1] not in pairs]
    if unknown:
        raise ValueError(
            f"guesses: expected names of runs, {', '.join(missions)}, got {unknown[0][0]}, {unknown[0][1]}"
        )
    known = {(b, a): inverse(b_T_a) for (a, b), b_T_a in guesses.items()} | dict(guesses)
    found = []
    for done, pair in enumerate(pairs):
        a, b = (missions[name].mission for name in pair)
        found.append(compare_missions(a, b, config, significance=significance / len(pairs), guess=known.get(pair)))
        if progress is not None:
            progress(done + 1, len(pairs))
    return found


def _solved(
    component: Component, missions: Mapping[str, FinishedMission], config: SlamConfig
) -> JoinedComponent | Comparison:
    """A component solved, or the overlap that the whole speaks against most, taken back."""
    members = [missions[name] for name in component.missions]
    maps = [member.mission for member in members]
    ties = ties_of(component.overlaps, maps)
    starts = {number: component.common_T_mission[name] for number, name in enumerate(component.missions)}
    maybe = candidates(maps, starts, ties, config)
    graphs = {number: member.graph for number, member in enumerate(members)}
    solution = JointSolution(graphs, starts, shared_by(len(members), [*ties, *maybe]), tuple(ties))
    try:
        solution.solve()
    except JoinError as error:
        if not component.overlaps:
            raise
        weakest = min(component.overlaps, key=lambda one: one.strength)
        return replace(weakest, verdict="revoked", reason=f"{error}; of its overlaps this has the least evidence")
    against = _contradicted(component, solution, config)
    if against is not None:
        return against
    for _ in range(_LOOKS):
        more = found_to_be_one(solution, maybe, config)
        if not more:
            break
        solution = replace(solution, ties=(*solution.ties, *more))
        solution.solve()
    return JoinedComponent(tuple(members), solution, classes_of(solution.ties, maps))


def _contradicted(component: Component, solution: JointSolution, config: SlamConfig) -> Comparison | None:
    """The overlap whose ties add more to the squared error of the whole than true ones would, the worst of them.

    What the ties of a true overlap add is chi2 with 3 degrees of freedom a tie at most, as in a loop closure.
    """
    numbers = {name: number for number, name in enumerate(component.missions)}
    whole, worst = solution.chi2(solution.ties), (0.0, None)
    for overlap in component.overlaps:
        pair = {numbers[overlap.first], numbers[overlap.second]}
        others = [tie for tie in solution.ties if {tie.first.mission, tie.second.mission} != pair]
        count = len(solution.ties) - len(others)
        if not count:
            continue
        added = whole - solution.chi2(others)
        beyond = added - float(chdtri(3 * count, config.association.new_significance))
        if beyond > worst[0]:
            reason = f"with it all missions together fit worse by chi2 {added:.0f} of {3 * count} dof"
            worst = (beyond, replace(overlap, verdict="revoked", reason=reason))
    return worst[1]


class Classes:
    """Landmarks that are one plane, as they are found: of one mission never two, for that told them apart itself."""

    def __init__(self, ties: Iterable[Tie] = ()) -> None:
        self._of: dict[Place, set[Place]] = {}
        for tie in ties:
            self.add(tie)

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
    return Classes(ties).all(
        Place(number, plane.id) for number, mission in enumerate(missions) for plane in mission.planes
    )


def ties_of(overlaps: Iterable[Comparison], missions: Sequence[Mission]) -> list[Tie]:
    """The ties of overlaps, the strongest overlaps first; what would make two landmarks of one mission one is not."""
    numbers = {mission.name: number for number, mission in enumerate(missions)}
    classes, ties = Classes(), []
    for overlap in sorted(overlaps, key=lambda one: -one.strength):
        a, b = numbers[overlap.first], numbers[overlap.second]
        for i, j in overlap.alignment.pairs if overlap.alignment is not None else ():
            tie = Tie(Place(a, missions[a].planes[i].id), Place(b, missions[b].planes[j].id))
            if classes.add(tie):
                ties.append(tie)
    return ties


def candidates(
    missions: Sequence[Mission], common_T_mission: Mapping[int, FloatArray], ties: Sequence[Tie], config: SlamConfig
) -> list[Tie]:
    """Landmarks that may turn out to be one once all missions are solved together: they lie over each other."""
    known, found = set(ties), []
    for (a, mine), (b, theirs) in combinations(enumerate(missions), 2):
        a_T_b = inverse(common_T_mission[a]) @ common_T_mission[b]
        for i, j, apart in facing_pairs(mine, theirs, a_T_b, config.association):
            tie = Tie(Place(a, mine.planes[i].id), Place(b, theirs.planes[j].id))
            if apart <= config.loops.tied_m and tie not in known:
                found.append(tie)
    return found


def found_to_be_one(solution: JointSolution, maybe: Sequence[Tie], config: SlamConfig) -> list[Tie]:
    """Of landmarks that may be one those that are, by chi2 (3 dof) with the joint covariance of all; best first."""
    classes = Classes(solution.ties)
    asked = [tie for tie in maybe if not classes.are_one(tie)]
    limit = float(chdtri(3, config.association.significance))
    ranked = []
    for tie, (difference, covariance) in zip(asked, solution.differences(asked), strict=True):
        chi2 = float(difference @ np.linalg.solve(covariance, difference))
        if chi2 <= limit:
            ranked.append((chi2, tie))
    return [tie for _, tie in sorted(ranked) if classes.add(tie)]


def shared_by(count: int, ties: Iterable[Tie]) -> dict[int, tuple[int, ...]]:
    """By mission, of so many, the landmarks that ties are about."""
    places = sorted({place for tie in ties for place in (tie.first, tie.second)})
    return {number: tuple(one.landmark for one in places if one.mission == number) for number in range(count)}
