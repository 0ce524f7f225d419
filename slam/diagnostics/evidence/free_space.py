"""Evidence: what one keyframe saw through, another one saw a surface at."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import binom

from slam.diagnostics.evidence.views import Comparison, View, comparisons, pairs_of
from slam.diagnostics.verdict import Evidence, named
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import NOVEL_SHARE
from spplanes._check import FloatArray

#: Share of looks through a surface in a sound map: people, doors, glass and edges, over a whole drive.
THROUGH_SHARE = 0.02


def free_space_evidence(keyframes: Sequence[Keyframe], views: dict[int, View], poses: FloatArray) -> Iterator[Evidence]:
    """Looks through surfaces at the final poses (N, 4, 4): over the whole drive, and about single keyframes.

    A surface that somebody else saw is confirmed or looked through; that it was not there then happens to a share of
    looks, of the whole drive `THROUGH_SHARE`, at one place `NOVEL_SHARE`. More of them than by chance are poses that
    do not fit together.
    """
    found = comparisons(views, poses, pairs_of(sorted(views), poses))
    through, looks = sum(one.through for one in found), sum(one.confirmed + one.through for one in found)
    if not looks:
        return
    suspects = _suspects(found, len(keyframes))
    worst = min(suspects.values(), default=1.0)
    whole = float(binom.sf(through - 1, looks, THROUGH_SHARE))
    frames = tuple(key for key, p_value in sorted(suspects.items()) if p_value < 0.05)
    share = through / looks
    size = f"{100.0 * share:.1f} % of {looks} looks at known surfaces go through them"
    where = f", most at {named(frames)}" if frames else ""
    broken = float(binom.sf(through - 1, looks, NOVEL_SHARE))
    grade = "broken" if broken < 1e-3 else "doubtful"
    yield Evidence("free space", grade, min(2.0 * min(whole, worst), 1.0), share, "of looks", frames, size + where)


def _suspects(found: Sequence[Comparison], count: int) -> dict[int, float]:
    """Probability of as many looks through surfaces from or at a keyframe, for as many keyframes as there are."""
    through, looks = np.zeros(count), np.zeros(count)
    for one in found:
        for key in (one.keyframe, one.other):
            through[key] += one.through
            looks[key] += one.confirmed + one.through
    p_values = np.minimum(count * binom.sf(through - 1, looks, NOVEL_SHARE), 1.0)
    return {int(key): float(p_values[key]) for key in np.flatnonzero(looks)}
