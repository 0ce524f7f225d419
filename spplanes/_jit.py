"""`numba.njit`, for whose functions a wheel may bring the machine code: then nothing is compiled where it is installed.

Numba keeps what it compiled in a cache, and knows it again by the source, the version of numba, the types of the
arguments, and the processor. A wheel is built on one machine and used on another, so its kernels are compiled for a
processor that both have something of (`PORTABLE`), and looked for under that name before numba's own cache is. What a
wheel does not bring, or was brought for another numba, Python or processor, is compiled at the first call as ever.
"""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numba
from numba import config
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.types import unliteral

#: Where a wheel has its kernels, a folder for every module.
BROUGHT = Path(__file__).parent / "_compiled"


class Processor(NamedTuple):
    """What code is compiled for, as NUMBA_CPU_NAME and NUMBA_CPU_FEATURES; what a processor must have to run it."""

    name: str
    features: str
    needs: frozenset[str]


PORTABLE = Processor("generic", "", frozenset())  # plain instructions, which all machines of a kind have
if platform.machine() in ("x86_64", "AMD64"):  # Intel since 2013, AMD since 2015
    _needs = "avx avx2 bmi bmi2 cx16 f16c fma lzcnt movbe popcnt sahf sse3 sse4.1 sse4.2 ssse3 xsave"
    PORTABLE = Processor("x86-64-v3", "", frozenset(_needs.split()))

#: Every kernel that was imported, in that order.
KERNELS: list[Any] = []


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `numba.njit` with these options and our own, and with what a wheel brings. All kernels have no entry
    for C, release Python's lock, and divide as numpy does. Numba compiles its own functions anew for every set of
    options that calls them."""

    def kernel_of(function: Callable[..., Any]) -> Any:
        settings: dict[str, Any] = {"no_cfunc_wrapper": True, "nogil": True, "error_model": "numpy", **options}
        kernel: Any = numba.njit(**settings)(function)
        if not config.DISABLE_JIT:  # type: ignore[attr-defined]
            if options.get("cache"):
                kernel._cache = _Cache(function)
            # kernels that call this one with 0, or with True, call what is compiled for any: numba compiles for each
            template_for = kernel.get_call_template
            kernel.get_call_template = lambda args, kws: template_for(
                [unliteral(arg) for arg in args], {name: unliteral(arg) for name, arg in kws.items()}
            )
            KERNELS.append(kernel)
        return kernel

    return kernel_of


def inner(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `njit` for what only kernels call. Without an entry for Python it compiles a seventh faster. Called
    from Python, it raises TypeError."""

    def inner_of(function: Callable[..., Any]) -> Any:
        kernel = njit(no_cpython_wrapper=True, **options)(function)
        if not config.DISABLE_JIT:  # type: ignore[attr-defined]

            def refuse(*_: Any, **__: Any) -> None:
                raise TypeError(f"{function.__module__}.{function.__qualname__}: only kernels can call it")

            kernel._insert = lambda *_: None  # numba would jump to the entry that is not there
            kernel._compile_for_args = refuse
        return kernel

    return inner_of


def inlined(function: Callable[..., Any]) -> Any:
    """A decorator for what one kernel calls in one place: compiled as a part of it, not alone. Not for what goes into a
    kernel that is long already: typing takes more than twice the time for twice the length."""
    return numba.njit(inline="always")(function)


@cache
def _tell_of_compiling() -> None:
    """Say it once: the first call ever seems to do nothing."""
    logging.getLogger(__name__).info("compiling for this machine, once: a minute or two if nothing is compiled yet")


@cache
def _are_brought() -> bool:
    """Whether there are kernels here that this processor can run, and nobody asked for those of another."""
    if not BROUGHT.is_dir() or config.CPU_NAME is not None or config.CPU_FEATURES is not None:  # type: ignore[attr-defined]
        return False
    from llvmlite.binding import get_host_cpu_features

    try:
        features = get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this machine
        return not PORTABLE.needs
    return all(features.get(need) for need in PORTABLE.needs)


class _Cache(FunctionCache):
    """Numba's cache of one function: what the wheel brought comes first, and what is in neither is told of."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        base, stamp = self._impl.filename_base, self._impl.locator.get_source_stamp()
        place = BROUGHT / function.__module__
        self._brought = IndexDataCacheFile(str(place), base, stamp) if _are_brought() else None

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        if self._brought is not None:
            (triple, *_), code = self._index_key(sig, target_context.codegen())[1:]
            data = self._brought.load((sig, (triple, PORTABLE.name, PORTABLE.features), code))
            if data is not None:
                return self._impl.rebuild(target_context, data)
        try:
            found = super()._load_overload(sig, target_context)
        except (ImportError, AttributeError):  # of an earlier version: it calls a kernel of a module that has moved
            found = None
        if found is None:
            _tell_of_compiling()
        return found
