"""Kernels that a wheel brings are used where they can run, and where nobody asked for others."""

from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import llvmlite.binding
import pytest
from numba import config
from numba.core.caching import FunctionCache

from spplanes import _jit


@pytest.fixture
def brought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A package that has kernels, for a processor that needs two things; numba's settings as they are by default."""
    monkeypatch.setattr(_jit, "BROUGHT", tmp_path)
    monkeypatch.setattr(_jit, "PORTABLE", _jit.Processor("some", "", frozenset({"avx2", "fma"})))
    monkeypatch.setattr(config, "CPU_NAME", None)
    monkeypatch.setattr(config, "CPU_FEATURES", None)
    _jit._are_brought.cache_clear()
    yield monkeypatch
    _jit._are_brought.cache_clear()


@pytest.mark.parametrize(
    ("features", "asked_for", "are_used"),
    [
        ({"avx2": True, "fma": True, "sse2": True}, None, True),
        ({"avx2": True, "fma": True, "sse2": True}, "generic", False),
        ({"avx2": True}, None, False),
        ({"avx2": True, "fma": False}, None, False),
        ({}, None, False),
    ],
)
def test_they_are_used_where_the_processor_has_what_they_need(brought, features, asked_for, are_used):
    """And where no other processor is asked for."""
    brought.setattr(llvmlite.binding, "get_host_cpu_features", lambda: features)
    brought.setattr(config, "CPU_NAME", asked_for)
    assert _jit._are_brought() == are_used


def test_every_kernel_comes_through_here():
    """A kernel made by `numba.njit` itself is compiled wherever it is installed."""
    root = Path(_jit.__file__).parents[1]
    sources = (path for package in ("spplanes", "factors", "slam") for path in (root / package).rglob("*.py"))
    theirs = [path.name for path in sources if "from numba import njit" in path.read_text(encoding="utf-8")]
    assert theirs == []


@pytest.fixture
def twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    """A kernel that is compiled when it is called."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    @_jit.njit(cache=True)
    def twice(x):
        return 2 * x

    yield twice
    _jit.KERNELS.remove(twice)


def test_it_is_said_once_that_something_is_compiled(twice: Callable, caplog: pytest.LogCaptureFixture):
    _jit._tell_of_compiling.cache_clear()
    with caplog.at_level("INFO", logger="spplanes._jit"):
        assert twice(2) == 4 and twice(2) == 4 and twice(2.0) == 4.0
    assert [record.message[:29] for record in caplog.records] == ["compiling for this machine, o"]


def test_what_only_kernels_call_refuses_python_and_serves_kernels():
    @_jit.inner()
    def half(x):
        return 0.5 * x

    @_jit.njit()
    def quarter(x):
        return half(half(x))

    for _ in range(2):  # before it is compiled, and after
        with pytest.raises(TypeError, match="half: only kernels can call it"):
            half(1.0)
        assert quarter(1.0) == 0.25
    for kernel in (half, quarter):
        _jit.KERNELS.remove(kernel)


def test_what_an_earlier_version_compiled_is_compiled_anew_where_a_module_has_moved(twice: Callable, monkeypatch):
    """Numba's cache of a kernel names the modules of kernels that it calls, and is not told when these move."""
    moved = Mock(side_effect=ModuleNotFoundError("No module named 'spplanes._eigen'"))
    monkeypatch.setattr(FunctionCache, "_load_overload", moved)
    assert twice(2) == 4
    assert moved.called
