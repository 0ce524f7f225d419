"""A wheel brings its kernels compiled: where it is installed nothing is compiled.

By default a wheel with the kernels of one plane of moments alone, as quick as may be; `make wheel` gives a whole one.
"""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent
GIVEN = os.environ.get("SPPLANES_WHEEL")

#: What a process compiled, took from the wheel, and left behind.
TOLD = """
import json
from spplanes import _jit
print(json.dumps({
    "place": str(_jit.BROUGHT),
    "compiled": [k.py_func.__name__ for k in _jit.KERNELS if k._cache_misses],
    "loaded": sum(bool(k._cache_hits) for k in _jit.KERNELS),
}))
"""
FIT = "import numpy as np; from spplanes import Moments\n" + (
    "plane = Moments.from_points(np.random.default_rng(1).random((99, 3)) * (1, 1, 0.01)).plane()\n"
    "print(plane.frame.tobytes().hex(), plane.covariance.tobytes().hex())\n"
)


def environment(**more: str) -> dict[str, str]:
    """Nothing of this clone, and none of numba's settings."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "PYTHONPATH"))}
    return {**kept, **more}


def output(words: list[object], environment: dict[str, str], folder: Path | None = None) -> str:
    """What a command prints that must end well."""
    done = subprocess.run(words, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if GIVEN:
        return Path(GIVEN).resolve()
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    output([*build, f"--wheel-dir={folder}", str(PROJECT)], environment(SPPLANES_KERNELS="plane"))
    [built] = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the wheel in it, and with what it needs from this one."""
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, symlinks=True)
    [packages] = folder.glob("lib/python*/site-packages")
    (packages / "needed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", f"--target={packages}", str(wheel)]
    output(pip, environment())
    return folder / "bin" / "python"


def told(python: Path, folder: Path, code: str, **more: str) -> tuple[list[str], dict[str, object]]:
    """What a program prints, and what became of the kernels; away from this clone, with a home of its own."""
    *lines, last = output([python, "-c", code + TOLD], environment(HOME=str(folder), **more), folder).splitlines()
    return lines, json.loads(last)


def left_behind(*folders: Path) -> list[Path]:
    return [file for folder in folders for file in folder.rglob("*.nb[ic]") if "_compiled" not in file.parts]


def test_the_wheel_says_what_it_is_for(wheel: Path):
    major, minor = sys.version_info[:2]
    assert f"cp{major}{minor}" in wheel.name and "none-any" not in wheel.name
    assert [name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("spplanes/_compiled/")]


def test_nothing_is_compiled_where_it_is_installed(python: Path, tmp_path: Path):
    printed, kernels = told(python, tmp_path, FIT)
    assert str(python.parent.parent) in str(kernels["place"]) and kernels["compiled"] == [] and kernels["loaded"]
    assert left_behind(python.parent.parent, tmp_path) == []
    elsewhere = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    compiled, without = told(python, tmp_path, FIT, **elsewhere)
    assert without["compiled"] and not without["loaded"]  # asked for another processor: the wheel has nothing
    assert printed == compiled  # to the bit


@pytest.mark.skipif(GIVEN is None, reason="of a whole wheel only: SPPLANES_WHEEL")
def test_nothing_is_compiled_by_a_fit_and_by_the_demo(python: Path, tmp_path: Path):
    cloud = (
        "import numpy as np; rng = np.random.default_rng(0)\n"
        "walls = [np.roll(np.c_[rng.random((9000, 2)) * 4, rng.normal(0, 0.003, 9000)], k, axis=1) for k in range(3)]\n"
        "np.save('cloud.npy', rng.permutation(np.concatenate(walls)))\n"
    )
    for words in (["fit", "cloud.npy"], ["demo", "--scans", "60", "--out", "demo"]):
        command = f"from slam.cli import main\ntry: main({words})\nexcept SystemExit: pass"
        _, kernels = told(python, tmp_path, cloud + command)
        assert kernels["compiled"] == [], words
        assert kernels["loaded"]
    assert left_behind(python.parent.parent, tmp_path) == []
