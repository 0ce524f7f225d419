"""Are the outputs of two versions the same to the bit? Hashes of trajectory.tum and planes.json over many drives.

Usage:
    python tools/compare_outputs.py record HASHES.json [--tree FOLDER] [--data FOLDER] [--only NAME ...]
    python tools/compare_outputs.py compare BEFORE.json AFTER.json

`record` runs the command line of the checkout in FOLDER (default: this one) as it stands, real logs and simulated
missions one after another, and writes the hashes. Drives whose data is absent are left out, by name. `compare` ends
with 1 where a hash differs or is missing.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
FILES = ("trajectory.tum", "planes.json")

#: Real logs, by their place in the data folder.
REAL = {
    "loop5": "loop5/loop5.clf.gz",
    "intel": "intel/intel.clf.gz",
    "3dtk_corridor": "3dtk_corridor",
    "balm_hall": "balm_hall",
}

#: Simulated missions: arguments of `spplanes simulate`.
SIMULATED = {f"corridor-{seed}": ["corridor", "--scans", "300", "--seed", str(seed)] for seed in (10, 11, 12, 13, 14)}
SIMULATED |= {f"office-{seed}": ["office", "--scans", "1200", "--seed", str(seed)] for seed in (10, 11, 12)}
SIMULATED |= {f"hall-{seed}": ["hall", "--scans", "12", "--seed", str(seed)] for seed in (10, 11)}


def main() -> int:
    """Record or compare, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    actions = parser.add_subparsers(dest="action", required=True)
    record = actions.add_parser("record")
    record.add_argument("hashes", type=Path)
    record.add_argument("--tree", type=Path, default=PROJECT)
    record.add_argument("--data", type=Path, default=PROJECT.parent / "shared" / "data")
    record.add_argument("--only", nargs="*", default=None)
    compare = actions.add_parser("compare")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.action == "compare":
        return _compare(json.loads(arguments.before.read_text()), json.loads(arguments.after.read_text()))
    hashes: dict[str, str] = {}
    for name in arguments.only or ["demo", *REAL, *SIMULATED]:
        hashes |= _hashes_of(name, arguments.tree.resolve(), arguments.data.resolve())
        arguments.hashes.write_text(json.dumps(hashes, indent=1) + "\n")
    return 0


def _hashes_of(name: str, tree: Path, data: Path) -> dict[str, str]:
    """Hashes of the files of one drive, by `drive/file`."""
    if name in REAL and not (data / REAL[name]).exists():
        print(f"{name}: left out, {data / REAL[name]} is absent", flush=True)
        return {}
    with tempfile.TemporaryDirectory() as work:
        out = Path(work) / "run"
        if name == "demo":
            _spplanes(tree, "demo", "--out", str(out))
        elif name in REAL:
            _spplanes(tree, "slam", str(data / REAL[name]), "--out", str(out))
        else:
            mission = Path(work) / "mission"
            _spplanes(tree, "simulate", *SIMULATED[name], "--out", str(mission))
            _spplanes(tree, "slam", str(mission), "--out", str(out))
        found = {f"{name}/{file}": hashlib.sha256((out / file).read_bytes()).hexdigest() for file in FILES}
    print(name, *(digest[:12] for digest in found.values()), flush=True)
    return found


def _spplanes(tree: Path, *arguments: str) -> None:
    """One command of the checkout `tree`."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "slam.cli", *arguments]
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}: {done.stderr.strip()}")


def _compare(before: dict[str, str], after: dict[str, str]) -> int:
    """Say which files differ; 1 where any does or is missing."""
    names = sorted(before | after)
    different = [name for name in names if before.get(name) != after.get(name)]
    for name in different:
        print(f"differs: {name}")
    print(f"{len(names) - len(different)} of {len(names)} files are the same to the bit")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
