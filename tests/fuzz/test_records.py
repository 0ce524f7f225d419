"""Records of a session with every part of them replaced by a part of another kind: an answer or one sentence."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.map.data_association import Candidate, Decision
from slam.session._codec import decode, encode
from slam.session.replay import _choice, _numbers
from tests.fuzz.target import Target
from tests.fuzz.targets import TARGETS
from tests.fuzz.wrapping import record, unrecorded

#: What may stand in a record.
OTHERS = (None, True, -1, 10**30, 0.5, 1e300, "x", [], {"tuple": []}, {"dict": {}}, {"array": ["<f8", [0], 0, 0]})


def replaced(data: bytes) -> Iterator[tuple[str, bytes]]:
    """The record with each of its parts as each of `OTHERS`, or gone; and where that was."""
    text, _, arrays = data.partition(b"\0")
    tree = json.loads(text)
    for path, holder, key in list(_parts(tree, "")):
        before = holder[key]
        for other in OTHERS:
            holder[key] = other
            yield f"{path} = {other}", json.dumps(tree).encode() + b"\0" + arrays
        if isinstance(holder, dict):
            del holder[key]
            yield f"{path} gone", json.dumps(tree).encode() + b"\0" + arrays
        holder[key] = before


def _parts(tree: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in inside:
        yield f"{path}.{key}", tree, key
        yield from _parts(value, f"{path}.{key}")


def _prior() -> bytes:
    content = decode(record(TARGETS["prior-bytes"].seeds()[0]))
    return encode({**content, "planes": content["planes"][:1], "covariance": content["covariance"][:3, :3]})


def _keyframe(index: int) -> bytes:
    values = decode(record(TARGETS["keyframe-bytes"].seeds()[index]))
    return encode({**values, "observations": values["observations"][:1]})


def _decisions() -> bytes:
    one = Candidate(3, 1.5, 3, -2.0, True)
    return encode([Decision(0, "match", one, (one,))])


def _compare_decisions(path: Path) -> None:
    """What a replay does with them."""
    found = decode(path.read_bytes(), list[Decision])
    assert all(_choice(one) == _choice(one) for one in found)
    numbers = [number for one in found for number in _numbers(one)]
    np.allclose(numbers, numbers)


DECISIONS = Target("decisions", _compare_decisions, list, wrap=record)
RECORDS = {
    "a prior": (TARGETS["prior-bytes"], _prior),
    "a keyframe with a plane": (TARGETS["keyframe-bytes"], lambda: _keyframe(1)),
    "a keyframe with a line": (TARGETS["keyframe-bytes"], lambda: _keyframe(2)),
    "decisions": (DECISIONS, _decisions),
}


@pytest.mark.parametrize(("target", "make"), RECORDS.values(), ids=RECORDS)
def test_a_record_with_a_part_of_another_kind_is_an_answer_or_one_sentence(target: Target, make: Any, tmp_path: Path):
    answers = []
    for where, changed in replaced(unrecorded(make())):
        try:
            answers.append(target.run(changed, tmp_path))
        except Exception as error:
            raise AssertionError(f"{where}: {type(error).__name__}: {error}") from error
    assert len(answers) > 100 and True in answers and False in answers
