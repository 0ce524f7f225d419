"""Peak memory of the tasks of a case, as JSON: `python -m benchmarks._peaks MODULE CASE`."""

from __future__ import annotations

import json
import sys
from importlib import import_module

from benchmarks._measure import Task
from benchmarks._memory import peak_mb


def main(module: str, case: str) -> None:
    """Print them."""
    tasks = import_module(module).CASES[case]()
    print(json.dumps([peak_mb(one.work, warm=one.repeats > 1) for one in tasks if isinstance(one, Task)]))


if __name__ == "__main__":
    main(*sys.argv[1:])
