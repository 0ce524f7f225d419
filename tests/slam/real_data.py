"""Where the real data lie, and what to say where they do not."""

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def needs(name: str) -> Path:
    """Path of a real file; the test is skipped where it is absent."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"real data {name} are not on this machine")
    return path
