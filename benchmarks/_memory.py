"""Peak memory of one call, in a process of its own: what is resident beyond what was there before the call.

Resident memory, because what a library written in C++ allocates is seen by no tracer of Python. Standard library only:
the peers' interpreter runs this as well. `python -m benchmarks._memory MODULE CASE` prints the peaks of a case.
"""

import ctypes
import gc
import json
import os
import re
import resource
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_mb(work: Callable[[], object], *, warm: bool = True) -> float:
    """Megabytes that a call needs at its worst beyond what was resident before; if warm the second call.

    Without /proc (not Linux) it is the growth of the largest resident size so far, which may hide a smaller peak.
    """
    if warm:  # nothing is loaded or compiled any more
        work()
    gc.collect()
    if os.name == "posix" and _STATUS.exists():
        ctypes.CDLL(None).malloc_trim(0)  # else what the call takes of the heap's free pages would not show
    try:
        _CLEAR.write_text("5")  # the kernel's mark of the highest resident size starts anew
    except OSError:
        before = _largest_mb()
        work()
        return _largest_mb() - before
    before = resident_mb()
    kept, peak = work(), _status_mb("VmHWM") - before
    del kept
    return peak


def resident_mb() -> float:
    """Resident size of this process now, MB."""
    return _status_mb("VmRSS")


def process_peak_mb() -> float:
    """Largest resident size of this process so far, MB."""
    return _status_mb("VmHWM") if _STATUS.exists() else _largest_mb()


def _status_mb(name: str) -> float:
    found = re.search(rf"^{name}:\s+(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    return int(found.group(1)) / 1024.0 if found else float("nan")


def _largest_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main(module: str, case: str) -> None:
    """Print the peaks of what a case of a module measures itself, as JSON."""
    tasks = [one for one in import_module(module).CASES[case]() if hasattr(one, "work")]
    print(json.dumps([peak_mb(one.work, warm=one.repeats > 1) for one in tasks]))


if __name__ == "__main__":
    main(*sys.argv[1:])
