"""Timing: where the time of a run goes, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class StageClock:
    """Wall time by stage, s. A stage inside another one stops the outer one's time: none is counted twice."""

    seconds: dict[str, float] = field(default_factory=dict)
    now: Callable[[], float] = time.perf_counter
    """What tells the time, s: `time.process_time` where other work on the machine is not to count."""
    _open: list[str] = field(default_factory=list, repr=False)
    _since: float = 0.0
    _began: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._began = self.now()

    @property
    def elapsed_s(self) -> float:
        """Time since the clock was made, s: of all stages, and of what is none."""
        return self.now() - self._began

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time inside the block to a stage."""
        self._turn()
        self._open.append(name)
        try:
            yield
        finally:
            self._turn()
            self._open.pop()

    def _turn(self) -> None:
        """Give the time since the last turn to the innermost stage."""
        now = self.now()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now


def timed(stage: str) -> Callable[[Callable[Concatenate[Any, P], R]], Callable[Concatenate[Any, P], R]]:
    """Add the time of a method to a stage of its object's `clock`."""

    def decorate(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
        @wraps(method)
        def run(self: Any, *args: P.args, **keywords: P.kwargs) -> R:
            with self.clock.stage(stage):
                return method(self, *args, **keywords)

        return run

    return decorate
