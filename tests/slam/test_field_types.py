"""What stands in a field is of the type that its class states: nothing is turned into it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from types import GenericAlias, SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import Point, Polygon, box

from slam._field_types import check_fields, holds
from slam.frontend.pose_measurements import PoseMeasurement


class Alias:
    """What numpy 2.5 has for NDArray from Python 3.12 on: an alias that is no class, whose value is one."""

    __value__ = np.ndarray[Any, np.dtype[Any]]


ALIAS = GenericAlias(Alias, (np.float64,))
#: A type, and what passes for it.
PASSES: list[tuple[Any, ...]] = [
    (int, 3, np.int64(3), -(1 << 63)),
    (float, 3, np.float32(0.5), float("nan")),
    (str, "x"),
    (bool, True),
    (str | None, None),
    (Literal["a", "b"], "b"),
    (tuple[int, str], (1, "x"), [1, "x"]),
    (tuple[int, ...], ()),
    (Sequence[int], range(2)),
    (list[float], [1, 2.0]),
    (NDArray[np.float64], np.zeros((0, 3))),
    (np.ndarray, np.arange(3)),
    (Polygon, box(0, 0, 1, 1)),
    (Sequence[PoseMeasurement], [SimpleNamespace(factor=len)]),  # of the caller's own
    (ALIAS, np.zeros(3)),
    (ALIAS | None, None),
]

#: What a validator that puts things right would take: sets and generators as tuples, 1 as True, bytes as text.
REFUSED: list[tuple[Any, ...]] = [
    (int, True, 3.0, "3", 1 << 63),
    (float, True, "0.5"),
    (str, b"x"),
    (bool, 1),
    (str | None, 3),
    (Literal["a", "b"], "c"),
    (tuple[int, str], (1, "x", 2), ("x", 1)),
    (tuple[int, ...], {1, 2}, (one for one in (1, 2)), np.arange(2)),
    (Sequence[str], "ab"),
    (Sequence[int], b"ab"),
    (list[float], [1.0, None]),
    (NDArray[np.float64], [1.0]),
    (ALIAS, [1.0], np.array(["a"])),
    (np.ndarray, np.array(["a"]), np.array([1j]), np.array([None])),
    (Polygon, Point(0, 0)),
    (Sequence[PoseMeasurement], [3]),
]


CASES = [(hint, value, rows is PASSES) for rows in (PASSES, REFUSED) for hint, *values in rows for value in values]


def named(value: object) -> str:
    """The same in every process: no address in it."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


@pytest.mark.parametrize(("hint", "value", "fits"), CASES, ids=named)
def test_what_a_field_takes(hint: Any, value: Any, fits: bool):
    assert holds(value, hint) is fits


@dataclass
class Record:
    """Something with fields."""

    size: int
    names: tuple[str, ...]


def test_the_first_field_that_is_wrong_is_named_and_values_stay_as_they_are():
    names = ["a"]
    record = Record(np.int64(3), names)  # type: ignore[arg-type]  # as a session gives them
    check_fields("record", record)
    assert record.names is names and type(record.size) is np.int64
    with pytest.raises(ValueError, match=r"record\.size: expected int, got float"):
        check_fields("record", Record(1.5, (3,)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"record\.names: expected tuple\[str, ...\], got set"):
        check_fields("record", Record(1, {"a"}))  # type: ignore[arg-type]


def test_a_type_that_nobody_knows_how_to_check_is_an_error_of_ours():
    with pytest.raises(TypeError, match="which nobody knows how to check"):
        holds(3, "a name")
