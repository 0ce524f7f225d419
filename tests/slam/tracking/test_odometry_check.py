"""Odometry is confirmed by the planes of two scans where these say what all returns could, and by nothing less."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corpus.drives import Drive, Recipe, make_drive
from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam, SlamConfig
from slam.frontend import odometry as odometry_readings
from slam.frontend.odometry import Motion
from slam.frontend.scan_surfaces import ON_NO_PLANE, ON_PLANE
from slam.geometry.frames import inverse
from slam.registration import relocalization
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import CloudScan
from slam.tracking import odometry_check
from slam.tracking.odometry_check import laid_by_planes, planes_confirm
from spplanes import Plane
from spplanes._check import FloatArray
from tests.slam.depth_scenes import with_widths
from tests.slam.registration.test_plane_registration import LONG, body, hall, measured, wall
from tests.slam.short_drives import errors_of, mapped_beginning, until, with_jump

#: Standard deviations of odometry over half a metre: (x, y, heading), and (z, roll, pitch).
SIGMAS, UPRIGHT = np.array([0.014, 0.007, 0.006]), (1e-3, 1e-3, 1e-3)
FIRST, SECOND = body(1.0, 0.5, 0.3), body(1.5, 0.6, 0.4)
SIGNIFICANCE = SlamConfig().association.new_significance


def odometry(off: FloatArray) -> Motion:
    """The motion between the two bodies, off by (x, y, heading)."""
    return Motion(inverse(FIRST) @ SECOND @ inverse(body(0.0, 0.0, 0.0)) @ body(*off), np.diag(SIGMAS**2), UPRIGHT)


def elements_of(planes: list[Plane]) -> FloatArray:
    """Surface elements at the corners of planes, in the frame that these are in."""
    rows = []
    for plane in planes:
        assert plane.outline is not None
        points = plane.centre + np.array(plane.outline.exterior.coords) @ plane.frame[:3, :2].T
        rows += [(*point, *plane.normal, 0.005, ON_PLANE) for point in points]
    return with_widths(np.array(rows))


def seen_twice(planes: list[Plane], seed: int) -> tuple[list[Plane], list[Plane]]:
    rng = np.random.default_rng(seed)
    return measured(planes, FIRST, rng), measured(planes, SECOND, rng)


def confirmed(motion: Motion, before: list[Plane], seen: list[Plane], elements: FloatArray) -> bool:
    fit = laid_by_planes(motion, before, seen)
    return fit is not None and planes_confirm(motion, *fit, elements, SIGNIFICANCE) is not None


def test_true_odometry_is_confirmed_by_the_planes_of_a_hall() -> None:
    rng = np.random.default_rng(0)
    for seed in range(60):
        before, seen = seen_twice(hall(), seed)
        motion = odometry(SIGMAS * rng.standard_normal(3))
        assert confirmed(motion, before, seen, elements_of(seen))


@pytest.mark.parametrize("off", [(0.5, 0, 0), (0, -0.4, 0), (0, 0, 0.1), (1, 1, 0.5), (0, 0.08, 0)])
def test_wrong_odometry_is_not(off: tuple[float, float, float]) -> None:
    before, seen = seen_twice(hall(), 1)
    assert not confirmed(odometry(np.array(off)), before, seen, elements_of(seen))


def test_what_planes_leave_open_is_left_to_the_returns_where_these_may_say_something() -> None:
    corridor = [*hall()[:2], *hall()[4:]]  # its long sides are left out: nothing stands across y
    before, seen = seen_twice(corridor, 2)
    motion, on_planes = odometry(np.zeros(3)), elements_of(seen)
    across = SECOND[:3, :3].T @ (0.0, 1.0, 0.0)
    clutter = with_widths(np.array([(*point, *across, 0.01, ON_NO_PLANE) for point in np.eye(3)]))
    # all returns leave it open as well
    assert confirmed(motion, before, seen, on_planes)
    assert not confirmed(motion, before, seen, np.vstack((on_planes, clutter)))


def test_planes_of_which_the_last_scan_had_less_than_half_confirm_nothing() -> None:
    before, seen = seen_twice(hall(), 3)
    motion, elements = odometry(np.zeros(3)), elements_of(seen)
    assert confirmed(motion, before[:5], seen, elements)
    assert not confirmed(motion, before[4:], seen, elements)
    assert not confirmed(motion, [], seen, elements)


def test_walls_across_the_way_that_find_no_partner_are_not_outvoted_by_those_along_it() -> None:
    """Off by as much as a board stands before a wall, the board is taken for the wall, and the wall for nothing."""
    off = 0.13
    before, seen = seen_twice([*hall(), wall((LONG - off, 0.0, 1.5), (-1.0, 0.0, 0.0), 2.0, 2.0)], 5)
    ahead = np.array([*(SECOND[:2, :2].T @ (off, 0.0)), 0.0])
    assert not confirmed(odometry(ahead), before, seen, elements_of(seen))
    assert confirmed(odometry(0.0 * ahead), before, seen, elements_of(seen))


def test_returns_are_laid_on_what_was_seen_only_where_planes_do_not_confirm(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, ask = [], relocalization.local_map
    monkeypatch.setattr(odometry_check, "local_map", lambda *given: asked.append(given) or ask(*given))
    before, seen = seen_twice(hall(), 4)
    for off, times in ((np.zeros(3), 0), (np.array([0.5, 0.0, 0.0]), 1)):
        asked.clear()
        slam = PlaneSlam()
        for k, (planes, motion) in enumerate(((before, None), (seen, odometry(off)))):
            observations = [PlaneObservation(plane) for plane in planes]
            slam.add_keyframe(Keyframe(k, observations, motion, surfaces=elements_of(planes)))
        assert len(asked) == times


def test_wheels_that_stand_for_a_while_are_left_aside_for_so_long() -> None:
    """A place at which next to nothing fits is none, however rarely wheels slip: drives such as this were 2 m off."""
    run, off = mapped_beginning("irregular/lidar32/stops", 895630, 36)
    steps = run.slam.odometry_record.steps
    against = [step.keyframe for step in steps if step.check.against]
    assert len(against) > 5 and len(against) <= against[-1] - against[0] + 1 < len(steps) / 2
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.2  # of the last step they told most


def test_wheels_that_stand_in_a_turn_are_found_out_and_do_not_make_the_map_doubtful() -> None:
    """A scan turned by 43 deg slid to where it met nothing at all, and so nothing that spoke against 9 m of error."""
    run, off = mapped_beginning("irregular/lidar64/stops", 121014, 15)
    assert [step.keyframe for step in run.slam.odometry_record.steps if step.check.against] == [11, 12, 13, 14]
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.003
    assert run.verdict.verdict == "sound"  # what was left aside errs, but nothing rests on it


def test_a_body_that_drove_steadily_does_not_stand_where_its_wheels_begin_to_hang() -> None:
    """Taken for a body that turns by 2 deg a step it was as likely to have stood: the drive was 4.3 m off."""
    run, off = mapped_beginning("ramp/lidar16/stops", 324011, 50)
    assert [step.keyframe for step in run.slam.odometry_record.steps if step.check.against] == list(range(43, 50))
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.01


def test_where_a_step_is_further_off_than_stated_the_scan_is_put_to_use() -> None:
    """The wheels stand for a fifth of the last step, 109 mm: no scan speaks against that, and planes leave it open."""
    run, off = mapped_beginning("ramp/lidar64/stops", 771022, 52)
    assert not run.slam.odometry_record.steps[48].check.against and run.slam.odometry_record.steps[47].check.against
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.015
    measured = [step for step in run.slam.odometry_record.steps if step.used != "not"]
    assert run.slam._sparsifier.n_measured == len(measured)  # wheels go on to be calibrated


@pytest.mark.parametrize(
    "name, seed, n_scans",
    [
        ("loop/depth/good/fifth", 620112, 8),  # along the corridor a scan slid by 7 m to where it fits nearly as well
        ("bare/lidar64/worse3/half", 620106, 14),  # and another by 0.7 m, then one by 3 m
        ("symmetric/depth/good/fifth", 660016, 15),  # a view of nothing seen before fits the other end of the building
        ("people/depth/good/fifth", 26110, 8),  # somebody at arm's length fills a third of an image
        ("irregular/depth/worse3/fifth", 661015, 12),  # one of all places within 5 m fits a view of nothing seen before
    ],
)
def test_odometry_is_believed_where_scans_fit_as_well_elsewhere(name: str, seed: int, n_scans: int) -> None:
    """Taken for wrong, the wheels were left aside: the drives ended 12, 28, 15, 2 and 4 m off."""
    run, off = mapped_beginning(name, seed, n_scans)
    assert not any(step.check.against for step in run.slam.odometry_record.steps)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.25


@pytest.mark.parametrize(
    "name, every, jump",
    [
        ("irregular/lidar32/good", 5, (3.0, 0.0, 0.0)),  # beams 2 deg apart: the map was 3 m off, and was called sound
        ("irregular/lidar32/good", 5, (0.0, 0.0, 1.0)),
        ("cluttered/lidar32/good", 5, None),  # odometry begins anew: the scan fits somehow where that leads
        ("people/depth/good", 1, None),
    ],
)
def test_odometry_that_jumps_is_found_out(
    name: str, every: int, jump: tuple[float, float, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what is seen, where its readings do not tell: of few, or where somebody has made two steps of the jump.

    The camera is known to 20 mm in the end.
    """
    monkeypatch.setattr(odometry_readings, "_jumps", lambda stamps_ns, poses: np.zeros(0, dtype=np.int64))
    run, off = mapped_with_jump(make_drive(Recipe.parse(name), 612), every, jump)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.015 and run.slam.odometry_record.steps[6].check.against


@pytest.mark.parametrize("aside_m", [0.05, 0.07])
def test_a_slip_of_a_few_sigmas_shifts_nothing(aside_m: float) -> None:
    """Its walls were taken for new ones, 53 and 72 mm beside those that they were: these planes spoke for it."""
    run, off = mapped_with_jump(make_drive(Recipe.parse("irregular/lidar16/good"), 122001), 1, (0.0, aside_m, 0.0))
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.003
    assert not any(step.check.against for step in run.slam.odometry_record.steps)


def mapped_with_jump(drive: Drive, every: int, jump: tuple[float, float, float] | None) -> tuple[Run, FloatArray]:
    """A run of 14 clouds, of every so many returns, whose odometry jumps at the eighth, or begins anew; its errors."""
    stamps = [scan.stamp_ns for scan in drive.log.scans()[:14]]
    at = next(reading.odom_T_body for reading in drive.log.odometry if reading.stamp_ns == stamps[7])
    off = inverse(at) if jump is None else at @ inverse(body(0.0, 0.0, 0.0)) @ body(*jump) @ inverse(at)
    log = with_jump(until(drive.log, stamps[-1]), stamps[7], off)
    clouds = [replace(e, points=e.points[::every]) if isinstance(e, CloudScan) else e for e in log.events]
    run = run_slam(replace(log, events=clouds), drive.rig, SlamConfig())
    return run, errors_of(run, drive)
