"""Build a release, look into it, and run it in clean environments: `python tools/release.py`, or `make release`.

Leaves an sdist and a wheel in dist/. Each supported Python that is here gets an environment of its own with the wheel
and what it depends on, nothing else, and runs the demo and the README there. Exit code 1 if anything is wrong; nothing
is uploaded.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Sequence
from email.parser import Parser
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parent.parent
DIST, WORK = ROOT / "dist", ROOT / "build" / "release"
PACKAGES = ("spplanes", "factors", "slam")
#: Oldest and newest minor version of Python 3 that is tried.
PYTHONS = range(11, 15)
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: What a build may put beside the sources: compiled kernels of numba.
CACHED = re.compile(r"\.nb[ic]$")


def main() -> int:
    """All of it; the exit code."""
    tools = environment(WORK / "tools", Path(sys.executable))
    run([tools, "-m", "pip", "install", "-q", "build", "twine"])
    shutil.rmtree(DIST, ignore_errors=True)
    run([tools, "-m", "build", "--outdir", DIST, ROOT], cwd=WORK)
    (sdist,), (wheel,) = DIST.glob("*.tar.gz"), DIST.glob("*.whl")
    problems = [*wheel_problems(wheel, version()), *sdist_problems(sdist, tracked())]
    if subprocess.run([tools, "-m", "twine", "check", "--strict", sdist, wheel], check=False).returncode:
        problems.append("twine check: see above")
    pythons = supported_pythons()
    if not pythons:
        problems.append("no supported Python found")
    for python in pythons:
        problems += problems_in(python, wheel, sdist)
    for problem in problems:
        print(f"release: {problem}", file=sys.stderr)
    if not problems:
        print(f"{wheel.name} and {sdist.name}: whole, and run under {len(pythons)} versions of Python; in {DIST}")
    return int(bool(problems))


def wheel_problems(wheel: Path, expected: str) -> list[str]:
    """What is wrong with the content of a wheel; `expected` is its version."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        about = f"spplanes-{expected}.dist-info"
        if f"{about}/METADATA" not in names:
            return [f"{wheel.name}: expected version {expected}, found no {about}/METADATA"]
        metadata = Parser().parsestr(archive.read(f"{about}/METADATA").decode())
    problems = []
    strange = sorted({name.split("/", 1)[0] for name in names} - {*PACKAGES, about})
    if strange:
        problems.append(f"expected nothing but {', '.join(PACKAGES)}, found {', '.join(strange)}")
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    packed = {name for name in names if not name.startswith(about) and not CACHED.search(name)}
    problems += [f"{name} is missing" for name in sorted(sources - packed)]
    problems += [f"{name} is no source" for name in sorted(packed - sources) if name.split("/", 1)[0] not in strange]
    if metadata["License-Expression"] != "BSD-3-Clause" or f"{about}/licenses/LICENSE" not in names:
        problems.append("expected the licence BSD-3-Clause with its text")
    wanted = ("Summary", "Requires-Python", "Description-Content-Type")
    problems += [f"metadata: {key} is missing" for key in wanted if not metadata[key]]
    if f"{about}/entry_points.txt" not in names:
        problems.append("the command spplanes is missing")
    return [f"{wheel.name}: {problem}" for problem in problems]


def sdist_problems(sdist: Path, known: set[str]) -> list[str]:
    """What is wrong with the content of an sdist; `known` are the files under version control."""
    with tarfile.open(sdist) as archive:
        names = {str(PurePosixPath(*PurePosixPath(one.name).parts[1:])) for one in archive.getmembers() if one.isfile()}
    problems = [f"{name} is not under version control" for name in sorted(names - known - {"PKG-INFO"})]
    wanted = {"LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml"}
    wanted |= {name for name in known if name.split("/", 1)[0] in PACKAGES}
    problems += [f"{name} is missing" for name in sorted(wanted - names)]
    return [f"{sdist.name}: {problem}" for problem in problems]


def problems_in(python: Path, wheel: Path, sdist: Path) -> list[str]:
    """Install the wheel in a clean environment of a Python, and run what a reader of the README runs first."""
    name = named(python)
    print(f"-- {name}", flush=True)
    home = WORK / name.replace(" ", "-").lower()
    inside = environment(home, python)
    command = inside.parent / "spplanes"
    if not wheel.name.endswith("-none-any.whl"):  # compiled for the Python that built it
        run([inside, "-m", "pip", "wheel", "-q", "--no-deps", "-w", home, sdist])
        (wheel,) = home.glob("*.whl")
    steps: list[tuple[str, Sequence[str | Path]]] = [
        ("install", [inside, "-m", "pip", "install", "-q", wheel]),
        ("dependencies", [inside, "-m", "pip", "check"]),
        ("licences", [inside, ROOT / "tools" / "licences.py"]),
        ("version", [command, "--version", "-v"]),
        ("demo", [command, "demo", "--out", "demo"]),
        ("README", [inside, "readme.py"]),
    ]
    with tempfile.TemporaryDirectory() as empty:  # nothing of the sources is importable from here
        text = (ROOT / "README.md").read_text(encoding="utf-8")
        Path(empty, "readme.py").write_text("\n".join(BLOCK.findall(text)), encoding="utf-8")
        for step, arguments in steps:
            print(f"   {step}", flush=True)
            if subprocess.run(arguments, cwd=empty, env=clean(), stdout=subprocess.DEVNULL, check=False).returncode:
                return [f"{name}: {step} failed"]
    return []


def environment(home: Path, python: Path) -> Path:
    """A new virtual environment; its interpreter."""
    shutil.rmtree(home, ignore_errors=True)
    home.parent.mkdir(parents=True, exist_ok=True)
    run([python, "-m", "venv", home])
    return home / "bin" / "python"


def supported_pythons() -> list[Path]:
    """One interpreter of each supported version: on the path, or of pyenv."""
    found: dict[int, Path] = {}
    pyenv = sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/*/bin/python"))
    for minor in PYTHONS:
        on_path = shutil.which(f"python3.{minor}")
        for candidate in [*([Path(on_path)] if on_path else []), *pyenv]:
            if minor not in found and named(candidate).startswith(f"Python 3.{minor}."):
                found[minor] = candidate
    return list(found.values())


def named(python: Path) -> str:
    """Such as "Python 3.12.1"; empty where it does not run."""
    done = subprocess.run([python, "--version"], capture_output=True, text=True, env=clean(), check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


def clean() -> dict[str, str]:
    """The environment's variables without those that lead Python to other packages."""
    return {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}


def version() -> str:
    """As the sources say."""
    text = (ROOT / "spplanes" / "_version.py").read_text(encoding="utf-8")
    return text.split('__version__ = "', 1)[1].split('"', 1)[0]


def tracked() -> set[str]:
    """Files under version control."""
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines())


def run(arguments: Sequence[str | Path], cwd: Path | None = None) -> None:
    """A command that must succeed."""
    subprocess.run(arguments, cwd=cwd, env=clean(), check=True)


if __name__ == "__main__":
    sys.exit(main())
