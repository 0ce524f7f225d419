"""Whatever is public and takes arrays is fuzzed, or said to take none."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.public import CALLS, PUBLIC, WITHOUT_ARRAYS, seed_of


def _public_names() -> Iterator[str]:
    """Of the three packages: functions, classes, and what a class can be asked to do."""
    for package in ("spplanes", "factors", "slam"):
        module = importlib.import_module(package)
        for name in module.__all__:
            found = getattr(module, name)
            yield f"{package}.{name}"
            if inspect.isclass(found):
                for member, value in vars(found).items():
                    if not member.startswith("_") and callable(getattr(found, member)) and not inspect.isclass(value):
                        yield f"{package}.{name}.{member}"


def test_every_public_function_is_fuzzed_or_takes_no_array():
    names = set(_public_names())
    listed = [{name.split(",")[0] for name in CALLS}, WITHOUT_ARRAYS]
    assert names - set.union(*listed) == set(), "say in tests/fuzz/public.py how to call them"
    assert set.union(*listed) - names == set(), "no longer public"
    assert sum(map(len, listed)) == len(set.union(*listed))


@pytest.mark.parametrize("number", range(len(CALLS)), ids=list(CALLS))
def test_what_it_takes_is_an_answer(number: int, tmp_path: Path):
    (target,) = PUBLIC
    assert target.run(seed_of(number), tmp_path)
