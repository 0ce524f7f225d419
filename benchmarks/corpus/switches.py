"""Mechanisms that the configuration can switch off, by name: what `python -m benchmarks ablation` goes through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from slam.config import SlamConfig


@dataclass(frozen=True)
class Switch:
    """One mechanism and how to do without it."""

    says: str
    """What it does, in a few words."""
    without: dict[str, dict[str, Any]]
    """Sections of `SlamConfig` and what their fields are then."""


#: A mechanism with a switch of its own is added here, one line.
SWITCHES: dict[str, Switch] = {
    "loop closure": Switch("places seen before are looked for and joined", {"loops": {"max_candidates": 0}}),
    "sparsification": Switch("keyframes of places passed often leave the graph", {"thinning": {"passes": 0}}),
    "late association": Switch("planes of uncertain tilt wait for a landmark", {"landmarks": {"waiting_keyframes": 0}}),
    "robust loops": Switch("a kernel on the factors that a closure re-keys", {"backend": {"robust_loops": None}}),
    "robust coasting": Switch("a kernel on matches at a pose the planes found", {"coasting": {"robust": None}}),
    "rivals": Switch(
        "a match waits where another landmark is about as likely", {"association": {"rival_log_ratio": 0.0}}
    ),
}


def changed(changes: dict[str, dict[str, Any]]) -> SlamConfig:
    """The default configuration but for some fields of some sections.

    Raises:
        ValueError: a section or a field that there is not, or a value that it cannot have.
    """
    whole = SlamConfig()
    sections = {}
    for name, fields in changes.items():
        section = getattr(whole, name, None)
        if section is None:
            raise ValueError(f"changes: expected sections of the configuration, got {name!r}")
        sections[name] = type(section).model_validate(section.model_dump() | fields)
    return whole.model_copy(update=sections)
