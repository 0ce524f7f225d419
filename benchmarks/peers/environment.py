"""The peers' own environment (mrob needs numpy < 2), made when asked for by `python -m benchmarks --peers`.

It is `.peers` in the project, which git ignores, or the interpreter that `$PEERS_PYTHON` names. A peer's script
gets its input as an npz and prints JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import venv
from pathlib import Path
from typing import Any

import numpy as np

PROJECT = Path(__file__).resolve().parents[2]
ENVIRONMENT = PROJECT / ".peers"
#: Whose versions the page of results tells.
PEERS = ("mrob", "kiss-icp")
PACKAGES = ("mrob==0.0.17", "kiss-icp==1.3.0", "numpy<2")
#: What a row says of a peer that is not there.
ABSENT = "not there (python -m benchmarks --peers)"


def peer_python() -> Path | None:
    """The interpreter that has the peers; None where there is none."""
    default = ENVIRONMENT / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    python = Path(os.environ.get("PEERS_PYTHON", default))
    return python if python.exists() else None


def make() -> Path:
    """Make the environment, or leave it as it is where it works; its interpreter.

    Raises:
        RuntimeError: it could not be made, in pip's words.
    """
    python = peer_python()
    check = "import kiss_icp, mrob"
    if python is None or subprocess.run([python, "-c", check], capture_output=True, check=False).returncode:
        venv.create(ENVIRONMENT, with_pip=True, clear=True)
        python = ENVIRONMENT / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        done = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", *PACKAGES], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"the peers' environment could not be made: {done.stderr.strip().splitlines()[-1]}")
    return python


def call(script: str, arrays: dict[str, Any], *words: str) -> Any:
    """What a script of this folder prints for these arrays, run by the peers' interpreter.

    Raises:
        RuntimeError: there is none, or the script failed.
    """
    python = peer_python()
    if python is None:
        raise RuntimeError(ABSENT)
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "input.npz", **arrays)
        done = subprocess.run(
            [python, "-m", f"benchmarks.peers.{script}", str(Path(folder) / "input.npz"), *words],
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
            cwd=PROJECT,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
    if done.returncode:
        raise RuntimeError(f"{script}: {(done.stderr.strip().splitlines() or ['no words'])[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def version(package: str) -> str | None:
    """Version of a package in the peers' environment; None where it is not."""
    python = peer_python()
    if python is None:
        return None
    words = [python, "-c", f"from importlib.metadata import version; print(version({package!r}))"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None
