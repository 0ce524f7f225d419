"""Whether what stands in the fields of a value is of the types that its class states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import shapely

Test = Callable[[Any], bool]
_MOST = 1 << 63


def check_fields(name: str, value: Any) -> None:
    """Refuse a dataclass whose fields hold something else than it says.

    Whole numbers are of 64 bits; arrays are of real numbers, of any shape; where a tuple is stated a list will do. What
    lies in a field and has fields of its own is not looked into. A ValueError names the first field that is wrong.
    """
    for field, passes, wanted in _tests_of(type(value)):
        if not passes(getattr(value, field)):
            found = type(getattr(value, field)).__name__
            raise ValueError(f"{name}.{field}: expected {wanted:.80}, got {found:.40}")


def holds(value: Any, hint: Any) -> bool:
    """Whether a value is of the type of an annotation, as `check_fields` understands it."""
    return _test(hint)(value)


@cache
def _tests_of(kind: type) -> tuple[tuple[str, Test, str], ...]:
    """For every field its name, what it must pass, and the type it states in words."""
    hints = get_type_hints(kind, localns={"Polygon": shapely.Polygon})
    return tuple((field.name, _test(hints[field.name]), str(field.type)) for field in fields(kind))


@cache
def _test(hint: Any) -> Test:
    origin, inside = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        tests = tuple(_test(one) for one in inside)
        return lambda value: any(test(value) for test in tests)
    if origin is Literal:
        return lambda value: isinstance(value, str) and value in inside
    if origin is tuple and inside[-1] is not ...:
        each = tuple(_test(one) for one in inside)
        return lambda value: (
            isinstance(value, tuple | list)
            and len(value) == len(each)
            and all(test(one) for test, one in zip(each, value, strict=True))
        )
    if origin in (list, tuple, Sequence):
        test = _test(inside[0])
        return lambda value: (
            isinstance(value, Sequence) and not isinstance(value, str | bytes) and all(map(test, value))
        )
    alias = getattr(origin, "__value__", None)  # NDArray[...], from numpy 2.5 and Python 3.12 on
    if np.ndarray in (hint, origin, get_origin(alias)):
        return lambda value: isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    if hint is int:
        return _is_whole
    if hint is float:
        return lambda value: isinstance(value, float | np.floating) or _is_whole(value)
    if getattr(hint, "_is_protocol", False):  # a measurement of the pose may be of a class of the caller's
        return lambda value: hasattr(value, "factor")
    if isinstance(hint, type):
        return lambda value: isinstance(value, hint)
    raise TypeError(f"a field of a record states {hint}, which nobody knows how to check")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and -_MOST <= int(value) < _MOST
