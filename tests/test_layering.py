"""Imports go spplanes <- factors <- slam, and nothing imports tests, examples or benchmarks."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "spplanes": {"factors", "slam", "gtsam", "gtsam_unstable", "pydantic", "typer", "rich", "open3d", "matplotlib"},
    "factors": {"slam", "pydantic", "typer", "rich", "open3d", "matplotlib"},
    "slam": set(),
}
NEVER = {"tests", "examples", "benchmarks"}


def imported_packages(source: str) -> set[str]:
    """Top-level names that a module imports, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


def modules() -> list[tuple[str, Path]]:
    return [(package, path) for package in FORBIDDEN for path in sorted((ROOT / package).rglob("*.py"))]


def test_every_package_has_modules():
    assert {package for package, _ in modules()} == set(FORBIDDEN)


@pytest.mark.parametrize(("package", "path"), modules(), ids=lambda value: str(value).removeprefix(f"{ROOT}/"))
def test_imports_point_one_way(package: str, path: Path):
    wrong = imported_packages(path.read_text(encoding="utf-8")) & (FORBIDDEN[package] | NEVER)
    assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_the_scanner_sees_nested_and_from_imports():
    source = "import os\ndef f():\n    from slam.cli import main\n    import gtsam.noiseModel as n\n"
    assert imported_packages(source) == {"os", "slam", "gtsam"}
