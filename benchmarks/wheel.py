"""The first `spplanes fit` in a clean environment: from a wheel that brings its kernels, and from one that does not.

Run as ``python -m benchmarks.wheel``. Both wheels are built first, which compiles all kernels unless they are in
`build/` already; what they depend on is taken from the environment that runs this.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from pathlib import Path

import numpy as np

from benchmarks._measure import PROJECT, Row
from benchmarks._table import plain

WHEELS = {"all": "kernels in the wheel", "": "compiled at the first call"}


def run(*, short: bool = False) -> list[Row]:
    """A row for every wheel and call; `short` changes nothing."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, rng = Path(scratch), np.random.default_rng(0)
        walls = [np.roll(np.c_[4 * rng.random((9000, 2)), rng.normal(0, 0.003, 9000)], k, axis=1) for k in range(3)]
        np.save(folder / "cloud.npy", rng.permutation(np.concatenate(walls)))
        rows = []
        for kernels, said in WHEELS.items():
            python, size = _environment(folder / (kernels or "none"), kernels)
            for call in ("first", "second"):
                wall, cpu = _fit(python, folder / (kernels or "none"), folder / "cloud.npy")
                what = f"{call} spplanes fit, 27,000 points, {said}"
                rows.append({"what": what, "s": wall, "CPU s": cpu, "wheel, MB": size})
        return rows


def _environment(folder: Path, kernels: str) -> tuple[Path, float]:
    """Its Python, and the size of the wheel that is installed in it, MB."""
    pip = [sys.executable, "-m", "pip"]
    build = [*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", f"--wheel-dir={folder}/dist", str(PROJECT)]
    subprocess.run(build, env=_settings(folder) | {"SPPLANES_KERNELS": kernels}, check=True, capture_output=True)
    [wheel] = (folder / "dist").iterdir()
    venv.create(folder / "clean", symlinks=True)
    [packages] = (folder / "clean").glob("lib/python*/site-packages")
    (packages / "needed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = [*pip, "install", "-q", "--no-deps", "--no-index", f"--target={packages}", str(wheel)]
    subprocess.run(install, env=_settings(folder), check=True, capture_output=True)
    return folder / "clean" / "bin" / "python", wheel.stat().st_size / 1e6


def _settings(folder: Path) -> dict[str, str]:
    """Nothing of this clone, none of numba's settings, and a home of its own."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("NUMBA_", "PYTHONPATH"))}
    return {**kept, "HOME": str(folder)}


def _fit(python: Path, folder: Path, cloud: Path) -> tuple[float, float]:
    """Wall and processor seconds of the command."""
    words, start = [str(python), "-m", "slam.cli", "fit", str(cloud)], time.perf_counter()
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    child = os.posix_spawn(words[0], words, _settings(folder), file_actions=quiet)
    _, status, used = os.wait4(child, 0)
    if status:
        raise RuntimeError(f"{' '.join(words)}: exit status {status}")
    return time.perf_counter() - start, used.ru_utime + used.ru_stime


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
