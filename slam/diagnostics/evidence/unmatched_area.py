"""Evidence: what was seen is matched to nothing, and never seen again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam.diagnostics.evidence._binomial import at_least
from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.verdict import Evidence, named
from slam.frontend.observations import LineObservation, Observation, PlaneObservation
from slam.frontend.occupancy import NOVEL_SHARE
from spplanes._check import FloatArray


def unmatched_evidence(run: Finished) -> Iterator[Evidence]:
    """Keyframes of whose surfaces, by area or by length, more than `NOVEL_SHARE` is of no plane that is seen twice.

    What is new is seen again from the next keyframe, or is clutter. In a sound run at most every second keyframe has
    more of it than that: a sign test.
    """
    shares = unmatched_shares(run)
    told = np.isfinite(shares)
    many = np.flatnonzero(told & (np.nan_to_num(shares) > NOVEL_SHARE))
    if not len(many):
        return
    count, frames, size = int(told.sum()), tuple(many.tolist()), float(np.nanmedian(shares))
    yield Evidence(
        "unmatched",
        "doubtful",
        float(at_least(len(many), count)),
        size,
        "of the area seen",
        frames,
        f"{len(many)} of {count} keyframes ({named(frames)}) see more that is never seen again than can be new: "
        f"{100.0 * size:.0f} % of a typical one's surfaces match nothing",
    )


def unmatched_shares(run: Finished) -> FloatArray:
    """Of every keyframe the share of what it saw that is of no plane seen twice, shape (N,); NaN: it saw nothing.

    The first keyframe, which has nothing to match, and the last, after which nothing is seen again, are left out.
    """
    late = {(one.keyframe, one.decision.observation) for one in run.late_matches}
    again = {
        (sighting.keyframe, sighting.observation)
        for landmark in run.landmarks
        if landmark.n_keyframes > 1
        for sighting in landmark.sightings
    }
    shares = np.full(len(run.keyframes), np.nan)
    for index in range(1, len(run.keyframes) - 1):
        sizes = np.array([_extent(one) for one in run.keyframes[index].observations])
        if not sizes.sum():
            continue
        lost = [
            one.match is None and (index, one.observation) not in late and (index, one.observation) not in again
            for one in run.decisions[index]
        ]
        shares[index] = sizes[lost].sum() / sizes.sum()
    return shares


def _extent(observation: Observation) -> float:
    """Area of a plane, m^2, length of a line, m."""
    if isinstance(observation, LineObservation):
        return observation.line.length
    if isinstance(observation, PlaneObservation) and observation.plane.outline is not None:
        return observation.plane.outline.area
    return 0.0
