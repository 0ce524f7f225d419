"""Evidence on the registration of two clouds: whether the place found is the right one, or one of many that fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slam.diagnostics.evidence.coverage import MOST_WRONG
from slam.diagnostics.evidence.innovations import PROMISED_M
from slam.diagnostics.verdict import Evidence, Verdict, at_least, weigh
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.registration.plane_registration import chance_of
from spplanes._check import FloatArray

#: A and B, as the keyframes of a run of two.
_BOTH = (0, 1)


@dataclass(frozen=True)
class CloudMatch:
    """What a place of cloud B in cloud A is judged by."""

    n_planes: int
    """Planes of B that could have been found in A."""
    matched: int
    """Planes that are in both at this place."""
    matched_elsewhere: tuple[int, ...]
    """The same at every other place that was looked at."""
    looks: tuple[tuple[int, int], tuple[int, int]]
    """By A of walls that B saw, and by B of those of A: confirmed, and gone through."""
    ambiguity: float
    """Probability that B is at one of those other places, by how well all returns fit."""


def judge(match: CloudMatch, covariance: FloatArray) -> Verdict:
    """The verdict on a place, with the covariance (6, 6), SP order, that is claimed for it."""
    evidence = [*_free_space(match), *_chance(match), *_unsure(match, covariance)]
    return weigh(evidence, kinds=2)  # lines of sight from either cloud


def _free_space(match: CloudMatch) -> Iterator[Evidence]:
    """Looks of one cloud through walls that the other saw, more than happens at the right place (binomial test)."""
    for name, other, (confirmed, through) in zip(("A", "B"), ("B", "A"), match.looks, strict=True):
        looks = confirmed + through
        if looks == 0:
            sentence = f"{name} looks at no wall that {other} saw: nothing could speak against the place"
            yield Evidence("free space", "doubtful", 0.0, 0.0, "looks", _BOTH, sentence)
            continue
        share = through / looks
        sentence = f"{100.0 * share:.0f} % of {looks} looks from {name} go through walls that {other} saw"
        p_value = float(at_least(through, looks, NOVEL_SHARE))
        yield Evidence("free space", "broken", p_value, share, "of looks", _BOTH, sentence)


def _chance(match: CloudMatch) -> Iterator[Evidence]:
    """As many planes in both as another place would have by chance."""
    chance = chance_of(match.matched, match.matched_elsewhere, match.n_planes)
    # lines of sight refute four in five places in other buildings and more: together within `SIGNIFICANCE`
    if chance > 0.05:
        sentence = (
            f"{match.matched} of {match.n_planes} planes are in both: with probability {chance:.2g} "
            "another place, or another building, would have as many"
        )
        yield Evidence("chance", "doubtful", 0.0, chance, "probability", _BOTH, sentence)


def _unsure(match: CloudMatch, covariance: FloatArray) -> Iterator[Evidence]:
    """Other places that fit so well that one may be it, and a position open further than a sound one may err."""
    if match.ambiguity > MOST_WRONG:
        sentence = f"with probability {match.ambiguity:.2g} B is at another place, which fits nearly as well"
        yield Evidence("ambiguity", "doubtful", 0.0, match.ambiguity, "probability", _BOTH, sentence)
    sigma = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
    if sigma > PROMISED_M:
        sentence = f"what both clouds saw leaves the position open: its standard deviation is {sigma:.2g} m"
        yield Evidence("open", "doubtful", 0.0, sigma, "m", _BOTH, sentence)
