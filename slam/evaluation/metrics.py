"""One line of an evaluation: what was measured, the value, its unit."""

from __future__ import annotations

from typing import NamedTuple


class Metric(NamedTuple):
    """A row of the table that `spplanes evaluate` prints."""

    name: str
    """What was measured."""
    value: float
    """The value; NaN where there was nothing to measure."""
    unit: str
    """Its unit; empty for counts."""
