"""What is the same for nearly every input is done once."""

from __future__ import annotations

import builtins
from typing import Any

_done: dict[str, dict[str, Any]] = {}


def remember_compiled_messages() -> None:
    """Let rosbags compile each text of message types once: it took nine tenths of the time of reading a bag."""
    try:
        from rosbags.serde import utils
        from rosbags.typesys import store
    except ImportError:
        return
    for module in (utils, store):
        module.exec = _exec_once  # type: ignore[attr-defined]  # found there before the built-in one


def _exec_once(code: str, namespace: dict[str, Any]) -> None:
    if code not in _done:
        before = set(namespace)
        builtins.exec(code, namespace)  # noqa: S102  # what rosbags would do
        if len(_done) > 10_000:
            _done.clear()
        _done[code] = {name: value for name, value in namespace.items() if name not in before}
    namespace.update(_done[code])
