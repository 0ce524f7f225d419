"""What no source of ours may do: run what a file says, unpack archives by their members' names, go through a shell."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(path for package in ("spplanes", "factors", "slam") for path in (ROOT / package).rglob("*.py"))

#: Modules whose formats run code when they are read.
FORBIDDEN_MODULES = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "jsonpickle"}
#: What reads no file: a pipe without a name, from a process that it forked itself; some of the values in a graph.
NO_FILES = {
    "slam/ahead.py": "import pickle",
    "factors/archive.py": "values.extract",
    "slam/backend/elimination.py": "linearised.extract",
}
FORBIDDEN_NAMES = {"eval", "exec", "compile", "__import__"}
#: Attributes by the name they are called under: YAML that builds objects, archives that write where they like, shells.
FORBIDDEN_ATTRIBUTES = {
    "yaml": {"load", "load_all", "full_load", "unsafe_load", "Loader", "UnsafeLoader"},
    "os": {"system", "popen"},
    "tempfile": {"mktemp"},
}
FORBIDDEN_METHODS = {"extract", "extractall", "unpack_archive"}
FORBIDDEN_KEYWORDS = {"allow_pickle": True, "shell": True}


def problems(source: str) -> list[str]:
    """What a source does that it may not, each with its line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module == "yaml":
            found += [f"{node.lineno}: yaml.{one.name}" for one in node.names if not one.name.startswith("safe_")]
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            found += [f"{node.lineno}: import {name}" for name in names if name.split(".")[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.Attribute):
            owner = node.value.id if isinstance(node.value, ast.Name) else ""
            if node.attr in FORBIDDEN_ATTRIBUTES.get(owner, set()) | FORBIDDEN_METHODS:
                found.append(f"{node.lineno}: {owner}.{node.attr}")
        elif isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id in FORBIDDEN_NAMES:
                found.append(f"{node.lineno}: {node.func.id}")
            pickles = [word.value for word in node.keywords if word.arg == "allow_pickle"]
            found += [f"{node.lineno}: allow_pickle" for one in pickles if not isinstance(one, ast.Constant)]
            given = {word.arg: word.value.value for word in node.keywords if isinstance(word.value, ast.Constant)}
            found += [f"{node.lineno}: {name}" for name, bad in FORBIDDEN_KEYWORDS.items() if given.get(name) is bad]
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_runs_what_a_file_says(path: Path):
    allowed = NO_FILES.get(path.relative_to(ROOT).as_posix(), "nothing")
    assert [one for one in problems(path.read_text(encoding="utf-8")) if not one.endswith(allowed)] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "eval('1')",
        "import yaml\nyaml.load('x')",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "import numpy as np\nnp.load('x', allow_pickle=bool(1))",
        "from yaml import load",
        "import zipfile\nzipfile.ZipFile('x').extractall()",
        "import subprocess\nsubprocess.run('x', shell=True)",
    ],
)
def test_the_scan_sees_what_it_looks_for(source: str):
    assert len(problems(source)) == 1
