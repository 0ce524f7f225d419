"""What `make release` looks for in a wheel and an sdist; what the core depends on is under permissive licences."""

import io
import tarfile
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from spplanes._version import __version__
from tools.licences import COPYLEFT, licence_of
from tools.release import PACKAGES, ROOT, sdist_problems, supported_pythons, version, wheel_problems

ABOUT = f"spplanes-{__version__}.dist-info"
METADATA = """Metadata-Version: 2.4
Name: spplanes
Summary: planes
License-Expression: BSD-3-Clause
Requires-Python: >=3.11
Description-Content-Type: text/markdown
"""


def content() -> dict[str, str]:
    """A wheel as it should be: every source, empty."""
    sources = [path for package in PACKAGES for path in (ROOT / package).rglob("*")]
    files = [path for path in sources if path.is_file() and "__pycache__" not in path.parts]
    packed = {path.relative_to(ROOT).as_posix(): "" for path in files}
    about = {"METADATA": METADATA, "licenses/LICENSE": "BSD", "entry_points.txt": "", "RECORD": "", "WHEEL": ""}
    return {**packed, **{f"{ABOUT}/{name}": text for name, text in about.items()}}


def wheel(folder: Path, files: dict[str, str]) -> Path:
    path = folder / f"spplanes-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


def test_a_wheel_as_it_should_be_and_one_with_compiled_kernels(tmp_path: Path):
    assert wheel_problems(wheel(tmp_path, content()), __version__) == []
    kernels = {"spplanes/fitting/__pycache__/_kernels.fit-12.py311.nbi": "", "spplanes/_compiled/a.f.py311.1.nbc": ""}
    assert wheel_problems(wheel(tmp_path, content() | kernels), __version__) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"tests/test_x.py": ""}, "expected nothing but spplanes, factors, slam, found tests"),
        ({"slam/secret.txt": ""}, "slam/secret.txt is no source"),
        ({"slam/__pycache__/config.cpython-311.pyc": ""}, "config.cpython-311.pyc is no source"),
        ({"slam/cli/__init__.py": None}, "slam/cli/__init__.py is missing"),
        ({"slam/visualization/viewer/viewer.js": None}, "viewer.js is missing"),
        ({"spplanes/py.typed": None}, "spplanes/py.typed is missing"),
        ({f"{ABOUT}/licenses/LICENSE": None}, "expected the licence BSD-3-Clause"),
        ({f"{ABOUT}/METADATA": METADATA.replace("BSD-3-Clause", "GPL-3.0-only")}, "expected the licence BSD-3-Clause"),
        ({f"{ABOUT}/METADATA": METADATA.replace("Requires-Python", "X-Python")}, "Requires-Python is missing"),
        ({f"{ABOUT}/entry_points.txt": None}, "the command spplanes is missing"),
        ({f"{ABOUT}/METADATA": None}, f"expected version {__version__}"),
    ],
)
def test_what_is_wrong_with_a_wheel(change: dict[str, str | None], problem: str, tmp_path: Path):
    files = {name: text for name, text in {**content(), **change}.items() if text is not None}
    found = wheel_problems(wheel(tmp_path, files), __version__)
    assert len(found) == 1 and problem in found[0]


def test_an_sdist_holds_what_is_under_version_control(tmp_path: Path):
    known = {"LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "slam/__init__.py", "tests/test_x.py"}

    def packed(*names: str) -> Path:
        path = tmp_path / "spplanes-1.tar.gz"
        with tarfile.open(path, "w:gz") as archive:
            for name in names:
                archive.addfile(tarfile.TarInfo(f"spplanes-1/{name}"), io.BytesIO())
        return path

    assert sdist_problems(packed(*known, "PKG-INFO"), known) == []
    assert sdist_problems(packed(*known - {"tests/test_x.py"}), known) == []
    (missing,) = sdist_problems(packed(*known - {"slam/__init__.py"}), known)
    assert "slam/__init__.py is missing" in missing
    (strange,) = sdist_problems(packed(*known, ".env"), known)
    assert ".env is not under version control" in strange


def test_this_python_is_supported_and_the_version_is_found():
    assert version() == __version__ and supported_pythons()


def core_packages() -> list[str]:
    """The dependencies of the core and theirs, as installed, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting, found = list(project["dependencies"]), set()
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
