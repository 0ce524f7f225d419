"""One workload in a process of its own: `python -m benchmarks._child NAME OUT.json ARGUMENTS`, arguments as JSON."""

import json
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._memory import process_peak_mb


def as_json(value: Any) -> Any:
    """Numbers of numpy as Python's own."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not known to JSON")


def main(name: str, out: str, arguments: str) -> None:
    """Run it, and write its rows, its seconds and the largest resident size of the process."""
    start = time.perf_counter()
    rows = import_module(f"benchmarks.{name}").run(**json.loads(arguments))
    result = {"rows": rows, "seconds": time.perf_counter() - start, "peak_MB": process_peak_mb()}
    Path(out).write_text(json.dumps(result, default=as_json))


if __name__ == "__main__":
    main(*sys.argv[1:])
