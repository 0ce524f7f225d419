"""What the core depends on is under permissive licences: a BSD-3 project cannot pass on more."""

from __future__ import annotations

import tomllib
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.licences import COPYLEFT, licence_of

ROOT = Path(__file__).resolve().parent.parent


def core_packages() -> list[str]:
    """The dependencies of the core and theirs, as installed, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting = list(project["dependencies"])
    found: set[str] = set()
    while waiting:
        wanted = Requirement(waiting.pop())
        name = canonicalize_name(wanted.name)
        if name in found or (wanted.marker is not None and not wanted.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        try:
            waiting += requires(name) or []
        except PackageNotFoundError:
            pytest.fail(f"{name}: a dependency of the core that is not installed")
    return sorted(found)


def test_the_closure_goes_beyond_what_is_written_down():
    assert {"numpy", "gtsam", "llvmlite", "pydantic-core", "contourpy"} <= set(core_packages())


@pytest.mark.parametrize("name", core_packages())
def test_a_core_dependency_is_no_copyleft(name: str):
    licence = licence_of(metadata(name))
    assert licence, f"{name} declares no licence"
    assert not COPYLEFT.search(licence), f"{name}: {licence}"


@pytest.mark.parametrize(
    ("licence", "refused"),
    [
        ("License :: OSI Approved :: GNU General Public License v3 or later (GPLv3+)", True),
        ("GPL-3.0-or-later", True),
        ("AGPL-3.0", True),
        ("GNU Affero General Public License v3", True),
        ("LGPL-2.1", False),
        ("GNU Lesser General Public License v2", False),
        ("BSD-3-Clause AND MIT", False),
    ],
)
def test_which_licences_are_refused(licence: str, refused: bool):
    assert bool(COPYLEFT.search(licence)) is refused
