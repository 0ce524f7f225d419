"""Evidence: so little was seen, or put to use, that the map cannot be held against anything."""

from __future__ import annotations

from collections.abc import Iterator

from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.verdict import Evidence, named

#: Keyframes with fewer than this many are no drive: nothing in them was seen twice and held against a third.
_LEAST_KEYFRAMES = 3


def coverage_evidence(run: Finished) -> Iterator[Evidence]:
    """Too few keyframes, an empty map, or a drive most of whose keyframes were placed by nothing that they saw.

    No statistic is needed: where nothing could have spoken against the map, that nothing did says nothing for it.
    """
    frames = range(len(run.keyframes))
    if len(frames) < _LEAST_KEYFRAMES:
        yield _certain(len(frames), frames, f"the run has only {len(frames)} keyframes: nothing was seen thrice")
        return
    wanted = run.config.landmarks.min_observations
    if not any(landmark.n_keyframes >= wanted and landmark.sightings for landmark in run.landmarks):
        yield _certain(len(frames), frames, f"the map is empty: no plane was seen again at {named(frames)}")
        return
    blind = unplaced(run)
    if 2 * len(blind) > len(frames) - 1:
        much = f"{len(blind)} of {len(frames) - 1} keyframes saw no plane that was known"
        yield _certain(len(blind), blind, f"{much} ({named(blind)}): odometry or an assumption alone placed them")


def unplaced(run: Finished) -> list[int]:
    """Keyframes after the first none of whose observations was matched, then or later."""
    late = {one.keyframe for one in run.late_matches}
    return [
        index
        for index, decisions in enumerate(run.decisions)
        if index and index not in late and all(one.match is None for one in decisions)
    ]


def _certain(count: int, keyframes: range | list[int], sentence: str) -> Evidence:
    return Evidence("coverage", "doubtful", 0.0, float(count), "keyframes", tuple(keyframes), sentence)
