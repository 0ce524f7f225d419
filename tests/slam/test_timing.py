"""Stages of a run and the run as a whole, timed."""

from slam.timing import StageClock


def test_what_is_no_stage_is_of_the_whole():
    times = iter((1.0, 2.0, 3.0, 5.0, 8.0, 20.0))
    clock = StageClock(now=lambda: next(times))
    with clock.stage("outer"), clock.stage("inner"):
        pass
    assert clock.seconds == {"outer": 1.0 + 3.0, "inner": 2.0} and clock.elapsed_s == 19.0
