"""Evidence: what one keyframe saw through, another one saw a surface at."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slam.diagnostics.evidence._binomial import at_least
from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, named
from slam.diagnostics.views.comparing import V, comparisons, pairs_of, way_along
from slam.frontend.occupancy import NOVEL_SHARE
from spplanes._check import FloatArray


@dataclass
class Place:
    """All that the keyframes about one place say of surfaces that others saw."""

    looks: int = 0
    """Looks at surfaces: confirmed, or gone through."""
    through: int = 0
    """Those that went through."""
    keyframes: set[int] = field(default_factory=set)
    """Who looked, and who had seen the surfaces."""

    def add(self, looks: int, through: int, keyframes: Sequence[int]) -> None:
        """Count more of them."""
        self.looks, self.through = self.looks + looks, self.through + through
        self.keyframes.update(keyframes)


def free_space_evidence(views: Mapping[int, V], poses: FloatArray) -> Iterator[Evidence]:
    """Looks through surfaces that other keyframes saw, at the final poses (N, 4, 4).

    That a surface was not there when another keyframe looked happens to `NOVEL_SHARE` of looks even about one place:
    people, doors, glass and edges. Each place has a binomial test, and its share of the significance (Bonferroni): one
    that fails is of poses that do not fit together. Where the whole drive fails, all of it is broken.
    """
    places: dict[Hashable, Place] = {}
    stretch = np.floor(way_along(poses)).astype(int).tolist()
    for one in comparisons(views, poses, pairs_of(sorted(views), poses)):
        pair = one.keyframe, one.other
        key = tuple(sorted(stretch[frame] for frame in pair))
        places.setdefault(key, Place()).add(one.confirmed + one.through, one.through, pair)
    if not places:
        return
    looks, through = (np.array(column) for column in zip(*((p.looks, p.through) for p in places.values()), strict=True))
    p_values = np.minimum(len(places) * at_least(through, looks, NOVEL_SHARE), 1.0)
    wrong = [place for place, p_value in zip(places.values(), p_values, strict=True) if p_value < SIGNIFICANCE]
    if not wrong:
        return
    frames = tuple(sorted(set().union(*(place.keyframes for place in wrong))))
    whole = float(at_least(through.sum(), looks.sum(), NOVEL_SHARE))
    gone, seen = sum(place.through for place in wrong), sum(place.looks for place in wrong)
    yield Evidence(
        "free space",
        "broken" if whole < SIGNIFICANCE else "doubtful",
        float(p_values.min()),
        gone / seen,
        "of looks",
        frames,
        f"at {named(frames)} {100.0 * gone / seen:.0f} % of {seen} looks go through surfaces that other keyframes saw "
        f"({100.0 * through.sum() / looks.sum():.1f} % of {looks.sum()} in the whole run)",
    )
