"""Work by processes ahead of whoever takes its results: the same in order, whatever becomes of the processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from slam.ahead import ordered_parallel_map

needs_fork = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")


@pytest.mark.parametrize("jobs", [1, 2, 3, 20])
@pytest.mark.parametrize("numbers", [range(0), range(1), range(2, 4), range(3, 20)])
def test_results_come_in_order(jobs: int, numbers: range):
    assert list(ordered_parallel_map(lambda number: number**2, numbers, jobs)) == [number**2 for number in numbers]


@needs_fork
def test_others_do_the_work():
    by = list(ordered_parallel_map(lambda _: os.getpid(), range(9), 2))
    assert by[0] == os.getpid()  # the first is done here, for all to begin with what it remembers
    assert len(set(by[1:])) == 2 and os.getpid() not in by[1:]


@needs_fork
def test_what_is_shared_comes_back_as_itself():
    shared = [object(), object()]
    found = list(ordered_parallel_map(lambda number: {"of": shared[number % 2], "own": [number]}, range(6), 2, shared))
    assert all(one["of"] is shared[number % 2] for number, one in enumerate(found))


@needs_fork
def test_an_error_is_raised_where_its_result_is_wanted():
    class _Own(ValueError):
        def __init__(self, one: int, two: int) -> None:  # cannot be unpickled
            super().__init__(f"{one} and {two}")

    def work(number: int) -> int:
        if number == 5:
            raise _Own(number, 2)
        return number

    taken = []
    with pytest.raises(_Own, match="5 and 2"):
        taken.extend(ordered_parallel_map(work, range(9), 3))
    results = ordered_parallel_map(work, range(9), 3)
    assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]


@needs_fork
def test_what_a_killed_process_owes_is_done_here():
    here = os.getpid()

    def work(number: int) -> int:
        if number == 4 and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    assert list(ordered_parallel_map(work, range(30), 2)) == list(range(30))


@needs_fork
def test_processes_wait_when_nobody_takes_their_results(tmp_path: Path):
    def work(number: int) -> bytes:
        (tmp_path / str(number)).touch()
        return bytes(1 << 19)  # two fit into a pipe

    results = ordered_parallel_map(work, range(100), 2)
    next(results), next(results)
    time.sleep(0.5)
    assert len(list(tmp_path.iterdir())) < 12
    results.close()  # type: ignore[attr-defined]


@needs_fork
def test_closing_ends_the_processes():
    results = ordered_parallel_map(lambda number: (time.sleep(0.01), os.getpid())[1], range(100), 2)
    pids = {next(results) for _ in range(3)} - {os.getpid()}
    results.close()  # type: ignore[attr-defined]
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@needs_fork
def test_processes_end_with_the_one_that_made_them():
    code = (
        "import os, sys, time; from slam.ahead import ordered_parallel_map\n"
        "for pid in ordered_parallel_map(lambda n: (time.sleep(0.05), os.getpid())[1], range(1000), 2):\n"
        "    print(pid, flush=True)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    child = subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    pids = {int(child.stdout.readline()) for _ in range(3)} - {child.pid}
    assert len(pids) == 2
    child.kill()
    child.wait()
    deadline = time.monotonic() + 5.0
    while any(_lives(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not any(_lives(pid) for pid in pids)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
