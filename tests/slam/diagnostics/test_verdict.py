"""A verdict follows from its evidence: each kind has its share of the significance, the gravest comes first."""

import json

import numpy as np
import pytest
from scipy.stats import binom

from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, Verdict, at_least, named, weigh


def found(p_value: float, grade: str = "doubtful", kind: str = "free space") -> Evidence:
    return Evidence(kind, grade, p_value, 0.3, "of looks", (4, 5), f"{kind} {p_value}")  # type: ignore[arg-type]


def test_a_run_that_nothing_speaks_against_is_sound():
    verdict = weigh([found(0.2)], 3)
    assert (verdict.verdict, verdict.reasons, verdict.keyframes) == ("sound", [], [])
    assert verdict.line == "the map is sound"


def test_kinds_share_the_significance():
    for share, verdict in ((0.9, "doubtful"), (1.1, "sound")):
        assert weigh([found(share * SIGNIFICANCE / 3)], 3).verdict == verdict


def test_what_is_broken_comes_first_and_names_its_keyframes():
    verdict = weigh([found(1e-9), found(1e-4, "broken", "mount"), found(0.5, "broken")], 2)
    assert (verdict.verdict, [one.kind for one in verdict.evidence]) == ("broken", ["mount", "free space"])
    assert verdict.line == "the map is broken: mount 0.0001; free space 1e-09" and verdict.keyframes == [4, 5]


@pytest.mark.parametrize(
    ("keyframes", "words"),
    [([3], "keyframe 3"), ([3, 4, 5, 9], "keyframes 3 to 5, 9"), ([9, 1, 3, 5, 7], "keyframes 1, 3, 5 and 2 more")],
)
def test_neighbouring_keyframes_are_named_together(keyframes: list[int], words: str):
    assert named(keyframes) == words


def test_a_verdict_comes_back_from_its_json():
    verdict = weigh([found(1e-9), found(1e-4, "broken", "mount")], 2)
    evidence = [one.to_dict() for one in verdict.evidence]
    assert set(verdict.to_dict()) == {"verdict", "reasons"}
    assert Verdict.from_dicts(json.loads(json.dumps(verdict.to_dict())), json.loads(json.dumps(evidence))) == verdict
    with pytest.raises(ValueError, match="expected sound, doubtful or broken, got 'fine'"):
        Verdict.from_dicts({"verdict": "fine"}, [])


def test_the_binomial_tail_is_the_survival_function_of_scipy_to_the_bit():
    rng = np.random.default_rng(0)
    trials = rng.integers(0, 3000, 5000)
    successes = (rng.random(5000) * (trials + 2)).astype(int)
    for share in (0.001, 0.05, 0.5):
        assert np.array_equal(at_least(successes, trials, share), binom.sf(successes - 1, trials, share))
