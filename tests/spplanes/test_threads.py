import os
import threading
from concurrent.futures import wait

import numpy as np
import pytest

from spplanes import _threads, segment_scans
from tests.spplanes.scenes import beam_covariances, box, cast, noisy, rays

SIGMA = 0.005


@pytest.fixture
def scan():
    """A room's points, seen by a laser from its middle, and their covariances."""
    points = noisy(cast(rays(), box())[0], SIGMA, 0)
    return points, beam_covariances(points, SIGMA)


@pytest.fixture
def threads(monkeypatch):
    """How many threads there are to be, also for few points."""

    def use(number):
        monkeypatch.setattr(_threads, "available", lambda: number)
        monkeypatch.setattr(_threads, "LEAST", 1)
        monkeypatch.setattr(_threads, "_pool", None)

    return use


def everything(points, covariances):
    labels, planes = segment_scans(points, covariances)
    return labels.tobytes(), planes


def test_planes_are_the_same_bits_whatever_the_number_of_threads(scan, threads):
    alone = everything(*scan)
    assert len(alone[1]) > 3
    for number in (2, 3, 8):
        threads(number)
        assert everything(*scan) == alone


@pytest.mark.parametrize("singly", [False, True])
def test_every_part_is_done_once_and_by_several_threads(threads, singly):
    threads(3)
    done, who, meet = np.zeros(50, dtype=int), set(), threading.Barrier(3, timeout=20)

    def work(first, last):
        if threading.get_ident() not in who:
            who.add(threading.get_ident())
            meet.wait()
        done[first:last] += 1

    _threads.in_parts(work, 50, 50, singly=singly)
    assert (done == 1).all()
    assert len(who) == 3


def test_few_points_wake_nobody(threads, monkeypatch):
    monkeypatch.setattr(_threads, "available", lambda: 8)
    parts = []
    _threads.in_parts(lambda *part: parts.append(part), 100, 2 * _threads.LEAST - 1)
    assert parts == [(0, 100)]


def test_a_fault_in_any_thread_comes_out(threads):
    threads(2)
    meet = threading.Barrier(2, timeout=20)

    def work(first, last):
        meet.wait()
        if threading.current_thread() is not threading.main_thread():
            raise ArithmeticError("in a helper")

    with pytest.raises(ArithmeticError, match="in a helper"):
        _threads.in_parts(work, 2, 2, singly=True)


def test_interrupted_work_is_left_to_nobody(threads):
    threads(2)
    meet, running = threading.Barrier(2, timeout=20), []

    def work(first, last):
        if meet.wait() >= 0 and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        running.append(True)
        wait([], timeout=0.05)
        running.pop()

    with pytest.raises(KeyboardInterrupt):
        _threads.in_parts(work, 2, 2, singly=True)
    assert not running


def test_without_another_thread_to_be_had_the_caller_does_it_all(threads, monkeypatch):
    threads(4)

    def refuse(*_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(_threads, "_threads", refuse)
    parts = []
    _threads.in_parts(lambda *part: parts.append(part), 16, 16)
    assert len(parts) == 16


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # that a process with threads forks
def test_a_fork_makes_threads_of_its_own(threads, scan):
    threads(2)
    expected = everything(*scan)
    assert _threads._pool is not None
    child = os.fork()
    if child == 0:
        os._exit(0 if everything(*scan) == expected else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
