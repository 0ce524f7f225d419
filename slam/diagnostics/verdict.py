"""The verdict of a run: sound, doubtful or broken, by evidence that would have shown it if the map were wrong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainc  # `scipy.stats` would take 0.7 s of every command

from spplanes._check import FloatArray

Grade = Literal["doubtful", "broken"]

#: Probability that a sound run is called doubtful or broken, over all kinds of evidence together.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Evidence:
    """One statistic of a finished run that speaks against its map, and how likely that is of a sound run."""

    kind: str
    """What was looked at, such as "free space"."""
    grade: Grade
    """What the run is if the statistic is significant: doubtful, some of it may be wrong; broken, it is."""
    p_value: float
    """Probability of a statistic as large in a run whose errors are as stated."""
    size: float
    """How large it is, in `unit`."""
    unit: str
    """Of the size."""
    keyframes: tuple[int, ...]
    """Keyframes it comes from, ascending."""
    sentence: str
    """For people: the keyframes and the size."""

    def to_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return {**asdict(self), "keyframes": list(self.keyframes)}


@dataclass(frozen=True)
class Verdict:
    """What a run says of its own map."""

    verdict: Literal["sound", "doubtful", "broken"]
    """sound: nothing that was looked at speaks against the map; doubtful: something does; broken: it is wrong."""
    evidence: tuple[Evidence, ...] = ()
    """What speaks against it, gravest first."""

    @property
    def reasons(self) -> list[str]:
        """One sentence for each piece of evidence, with keyframes and a size."""
        return [one.sentence for one in self.evidence]

    @property
    def line(self) -> str:
        """The verdict in one line."""
        return f"the map is {self.verdict}" + (f": {'; '.join(self.reasons)}" if self.evidence else "")

    @property
    def keyframes(self) -> list[int]:
        """Keyframes that the evidence comes from, ascending."""
        return sorted({keyframe for one in self.evidence for keyframe in one.keyframes})

    def to_dict(self) -> dict[str, Any]:
        """For metrics.json, where the evidence itself has a place of its own."""
        return {"verdict": self.verdict, "reasons": self.reasons}

    @classmethod
    def from_dicts(cls, verdict: Any, evidence: Any) -> Verdict:
        """From what metrics.json holds; whatever else is there instead is a ValueError, a KeyError or a TypeError."""
        word = verdict["verdict"]
        if word not in ("sound", "doubtful", "broken"):
            raise ValueError(f"verdict: expected sound, doubtful or broken, got {word!r:.40}")
        fields: list[dict[str, Any]] = [{**one, "keyframes": tuple(map(int, one["keyframes"]))} for one in evidence]
        return cls(word, tuple(Evidence(**field) for field in fields))


def at_least(successes: ArrayLike, trials: ArrayLike, share: float = 0.5) -> FloatArray:
    """Probability of so many successes or more of so many trials, each of probability ``share``; shapes broadcast."""
    k, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(trials, dtype=float))
    inside = (k > 0) & (k <= n)
    tail = betainc(np.where(inside, k, 1.0), np.where(inside, n - k + 1.0, 1.0), share)
    return np.where(inside, tail, np.where(k <= 0, 1.0, 0.0))


def weigh(evidence: Iterable[Evidence], kinds: int) -> Verdict:
    """The verdict by all evidence found in a run.

    Each of the `kinds` of statistics that were looked at has its share of `SIGNIFICANCE` (Bonferroni), so that looking
    at more of them calls no more sound runs doubtful. A wrong mount comes first: it explains the rest.
    """
    against = [one for one in evidence if one.p_value < SIGNIFICANCE / max(kinds, 1)]
    ordered = tuple(
        sorted(against, key=lambda one: (one.grade != "broken", one.kind != "mount", one.p_value, one.kind))
    )
    if not ordered:
        return Verdict("sound")
    return Verdict(ordered[0].grade, ordered)


def ranges_of(keyframes: Iterable[int]) -> list[list[int]]:
    """Keyframes in ranges of neighbours, ascending."""
    numbered = enumerate(sorted(set(keyframes)))
    return [[one for _, one in group] for _, group in groupby(numbered, key=lambda pair: pair[1] - pair[0])]


def named(keyframes: Sequence[int]) -> str:
    """Keyframes for a sentence: "keyframe 3", "keyframes 3 to 9, 14 and 3 more ranges"; neighbours go together."""
    ranges = ranges_of(keyframes)
    if [len(part) for part in ranges] == [1]:
        return f"keyframe {ranges[0][0]}"
    told = [str(part[0]) if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in ranges[:3]]
    more = len(ranges) - len(told)
    return f"keyframes {', '.join(told)}" + (f" and {more} more" if more else "")
