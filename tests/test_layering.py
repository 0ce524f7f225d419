"""Imports point one way: between the packages, between the rooms of each, and never in a circle."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FORBIDDEN = {
    "spplanes": {"factors", "slam", "gtsam", "gtsam_unstable", "pydantic", "typer", "rich", "open3d", "matplotlib"},
    "factors": {"slam", "pydantic", "typer", "rich", "open3d", "matplotlib"},
    "slam": set(),
}
NEVER = {"tests", "examples", "benchmarks"}

#: Rooms from the ground up: each imports from rooms of earlier steps only, and those of one step stand apart.
ORDER = {
    "slam": (
        "errors timing ahead _field_types < _yaml lazy < config < geometry < sensors < io < frontend < backend < map"
        " < registration < tracking < mapping < loop_closure < session < files < planeslam < diagnostics < floorplan"
        " < simulation < evaluation < joining < runs < visualization < output < fleet < cli"
    ),
    "spplanes": (
        "_version _check _jit _threads < _hesse _rows noise spmodel < plane line < moments < fitting outlines"
        " < clouds lines registration < segmentation < mapping"
    ),
}
ROOMS = {package: [rooms.split() for rooms in order.split(" < ")] for package, order in ORDER.items()}
#: No folder holds more modules than this, `__init__` apart; `slam` itself fewer.
MOST_MODULES, MOST_IN_SLAM = 15, 10


def modules() -> dict[str, Path]:
    """Every module of the three packages by its dotted name; a package goes by its own."""
    found = {}
    for package in FORBIDDEN:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports_of(source: str, known: set[str] | dict[str, Path] = frozenset()) -> set[str]:
    """What a module imports, wherever in the file; `from a import b` is a.b where that is a known module, else a."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            whole = (f"{node.module}.{alias.name}" for alias in node.names)
            names.update(one if one in known else node.module for one in whole)
    return names


#: Imports among our own modules.
GRAPH = {
    name: (imports_of(path.read_text(encoding="utf-8"), MODULES) & MODULES.keys()) - {name}
    for name, path in MODULES.items()
}


def room_of(module: str) -> str | None:
    """The room of a module, its second name; None for the door of a package."""
    return module.split(".")[1] if "." in module else None


def uphill(package: str) -> Iterator[str]:
    """Imports that point up in the table of rooms, or to another room of the same line."""
    height = {room: line for line, rooms in enumerate(ROOMS[package]) for room in rooms}
    for module, imported in GRAPH.items():
        here = room_of(module)
        if not module.startswith(f"{package}.") or here is None:
            continue
        for other in imported:
            there = room_of(other)
            if other.startswith(f"{package}.") and there not in (None, here) and height[there] >= height[here]:
                yield f"{module} imports {other}"


@pytest.mark.parametrize("module", MODULES)
def test_packages_import_one_way(module: str):
    packages = {name.split(".")[0] for name in imports_of(MODULES[module].read_text(encoding="utf-8"))}
    assert not packages & (FORBIDDEN[module.split(".")[0]] | NEVER)


@pytest.mark.parametrize("package", ROOMS)
def test_every_module_has_a_room(package: str):
    listed = [room for rooms in ROOMS[package] for room in rooms]
    there = {room_of(name) for name in MODULES if name.startswith(f"{package}.")}
    assert sorted(listed) == sorted(there)


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_import_from_rooms_below(package: str):
    assert sorted(uphill(package)) == []


def test_no_import_comes_back_to_where_it_began():
    try:
        TopologicalSorter(GRAPH).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_no_room_is_crowded():
    crowded = {}
    for folder in {path.parent for path in MODULES.values()}:
        count = len([path for path in folder.glob("*.py") if path.name != "__init__.py"])
        if count > (MOST_IN_SLAM if folder.name == "slam" else MOST_MODULES):
            crowded[str(folder.relative_to(ROOT))] = count
    assert crowded == {}


@pytest.mark.parametrize("package", ["spplanes", "slam"])
def test_tests_mirror_the_rooms(package: str):
    folders = {path.name for path in (ROOT / "tests" / package).iterdir() if (path / "__init__.py").exists()}
    rooms = {room_of(name) for name in MODULES if name.startswith(f"{package}.")}
    assert folders <= rooms


def test_the_scanner_sees_nested_and_from_imports():
    source = "import os\ndef f():\n  from slam.cli import main\n  import gtsam.noiseModel\n  from slam import cli\n"
    assert imports_of(source, {"slam.cli"}) == {"os", "slam.cli", "gtsam.noiseModel"}
