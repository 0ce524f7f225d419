"""The peers' own environment (mrob needs numpy < 2), made when asked for by `python -m benchmarks --peers`.

It is `.peers` in the project, which git ignores, or the interpreter that `$PEERS_PYTHON` names. A peer's script
gets its input as an npz and prints JSON.
"""

import json
import os
import tempfile
import venv
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import PROJECT, printed_by

ENVIRONMENT = PROJECT / ".peers"
PYTHON = ENVIRONMENT / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
#: Whose versions the page of results tells.
PEERS = ("mrob", "kiss-icp")
PACKAGES = ("mrob==0.0.17", "kiss-icp==1.3.0", "numpy<2")
#: What a row says of a peer that is not there.
ABSENT = "not there (python -m benchmarks --peers)"


def peer_python() -> Path | None:
    """The interpreter that has the peers; None where there is none."""
    python = Path(os.environ.get("PEERS_PYTHON", PYTHON))
    return python if python.exists() else None


def make() -> Path:
    """Make the environment, or leave it as it is where it works; its interpreter."""
    python = peer_python()
    if python is not None:
        with suppress(RuntimeError):
            printed_by(python, "-c", "import kiss_icp, mrob")
            return python
    venv.create(ENVIRONMENT, with_pip=True, clear=True)
    printed_by(PYTHON, "-m", "pip", "install", "--quiet", *PACKAGES)
    return PYTHON


def call(script: str, arrays: dict[str, Any], *words: str) -> Any:
    """What a script of this folder prints for these arrays, run by the peers' interpreter; RuntimeError: why not."""
    python = peer_python()
    if python is None:
        raise RuntimeError(ABSENT)
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "input.npz", **arrays)
        told = ("-m", f"benchmarks.peers.{script}", str(Path(folder) / "input.npz"), *words)
        return json.loads(printed_by(python, *told, timeout_s=600.0).splitlines()[-1])


def version(package: str) -> str | None:
    """Version of a package in the peers' environment; None where it is not."""
    python, ask = peer_python(), f"from importlib.metadata import version; print(version({package!r}))"
    with suppress(RuntimeError):
        return None if python is None else printed_by(python, "-c", ask).strip()
    return None
