"""A place found by its planes alone: worked out to what they were measured to, and not behind walls."""

import gtsam
import numpy as np
import pytest
from shapely import box

from slam.geometry.frames import inverse
from slam.registration._plane_arrays import PlaneArrays
from slam.registration.motion_from_planes import differences, fit_pairs
from slam.registration.plane_registration import _agreement, places_anywhere, register_planes_globally
from slam.registration.visibility import LinesOfSight
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.spmodel import transform_from_rpy
from tests.factors.factor_scenes import perturbed
from tests.statistics import assert_jacobian

#: A hall that looks the same from both ends: half its length, half its width, height, m.
LONG, WIDE, HIGH = 9.0, 5.0, 4.0


def wall(middle: tuple[float, float, float], normal: tuple[float, float, float], width: float, height: float) -> Plane:
    """A rectangle about its middle, seen from the side of its normal, known to 2 mm and 0.05 deg."""
    z = np.array(normal) / np.linalg.norm(normal)
    x, frame = np.cross((0.0, 0.0, 1.0) if abs(z[2]) < 0.9 else (0.0, 1.0, 0.0), z), np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, middle
    outline = box(-width / 2.0, -height / 2.0, width / 2.0, height / 2.0)
    return Plane(frame, np.diag([2e-3, 1e-3, 1e-3]) ** 2, 1000, outline)


def hall(far: float = LONG) -> list[Plane]:
    """Floor, ceiling, sides and ends of the hall, or of its part that ends at an x."""
    half, middle, length = HIGH / 2.0, (far - LONG) / 2.0, far + LONG
    return [
        wall((middle, 0.0, 0.0), (0.0, 0.0, 1.0), 2.0 * WIDE, length),
        wall((middle, 0.0, HIGH), (0.0, 0.0, -1.0), 2.0 * WIDE, length),
        wall((middle, WIDE, half), (0.0, -1.0, 0.0), length, HIGH),
        wall((middle, -WIDE, half), (0.0, 1.0, 0.0), length, HIGH),
        wall((far, 0.0, half), (-1.0, 0.0, 0.0), 2.0 * WIDE, HIGH),
        wall((-LONG, 0.0, half), (1.0, 0.0, 0.0), 2.0 * WIDE, HIGH),
    ]


def body(x: float, y: float, yaw: float) -> FloatArray:
    return transform_from_rpy((x, y, 1.5, yaw, 0.0, 0.0))


def measured(planes: list[Plane], world_T_body: FloatArray, rng: np.random.Generator) -> list[Plane]:
    """The planes as a body sees them: each off by what its covariance says."""
    seen = []
    for plane in planes:
        moved = plane.transform(inverse(world_T_body))
        frame = perturbed(moved.frame, rng.multivariate_normal(np.zeros(3), moved.covariance))
        seen.append(Plane(frame, moved.covariance, moved.n_points, moved.outline))
    return seen


def test_a_wall_and_the_face_of_a_pillar_have_the_pillar_in_common():
    gable, face = wall((0.0, 0.0, 2.0), (1.0, 0.0, 0.0), 10.0, 4.0), wall((0.0, 1.0, 2.0), (1.0, 0.0, 0.0), 0.5, 4.0)
    seen = PlaneArrays.of([gable])
    assert _agreement(np.eye(4), seen, PlaneArrays.of([gable])) == pytest.approx(np.sqrt(40.0))
    assert _agreement(np.eye(4), seen, PlaneArrays.of([face])) == pytest.approx(np.sqrt(2.0))


def test_derivatives_of_what_planes_are_off():
    rng, known = np.random.default_rng(0), hall()
    motion = gtsam.Pose3.Expmap(rng.normal(0.0, 0.3, 6)).matrix()
    for one, other in zip(measured(known, body(1.0, 0.5, 0.3), rng), known, strict=True):

        def off(step: FloatArray, one: Plane = one, other: Plane = other) -> tuple[FloatArray, FloatArray]:
            there = motion @ gtsam.Pose3.Expmap(step).matrix()
            return differences(there[None], one.frame[None], other.normal[None], np.array([other.d]))

        assert_jacobian(lambda step, off=off: off(step)[0][0], np.zeros(6), off(np.zeros(6))[1][0], atol=1e-6)


def test_a_motion_is_worked_out_as_well_as_it_says():
    """The covariance grants planes a centimetre more than these have; one pair in seven is wrong."""
    rng, known, nees = np.random.default_rng(1), hall(), []
    for _ in range(40):
        true = body(*rng.uniform((-4.0, -2.0, -0.3), (4.0, 2.0, 0.3)))
        seen = measured(known, true, rng)
        wrong = known[4].transform(body(0.12, 0.0, 0.02)), seen[4]
        pairs = [*zip(seen, known, strict=True), wrong[::-1]]
        rough = true @ gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6) * np.repeat([0.01, 0.03], 3)).matrix()
        motion, covariance = rough, np.eye(6)
        for loose in (5.0, 1.0):
            motion, covariance = fit_planes_on(motion, pairs, (10.0, 3.0), loose)  # type: ignore[misc]
        error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(motion) @ true))
        assert np.linalg.norm(error[3:]) < 0.02
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 0.2 < np.mean(nees) < 6.0


def fit_planes_on(
    motion: FloatArray, pairs: list[tuple[Plane, Plane]], sigmas: tuple[float, float], loose: float = 1.0
) -> tuple[FloatArray, FloatArray] | None:
    seen, known = (PlaneArrays.as_given(planes) for planes in zip(*pairs, strict=True))
    both = np.repeat(np.arange(len(pairs))[:, None], 2, axis=1)
    return fit_pairs([motion], seen, known, [both], sigmas, loose)[0]


def test_planes_that_leave_a_motion_open_are_refused():
    floor, ceiling, *_ = hall()
    assert fit_planes_on(np.eye(4), [(floor, floor), (ceiling, ceiling)], (1.0, 1.0)) is None
    assert fit_planes_on(np.eye(4), [(floor, floor), (ceiling, ceiling), (floor, floor)], (1.0, 1.0)) is None


def test_walls_stand_in_the_way_from_the_wrong_end_only():
    screen = wall((5.0, 0.0, 1.5), (1.0, 0.0, 0.0), 8.0, 3.0)
    true, wrong = body(2.0, 0.5, 0.2), body(-2.0, -0.5, 0.2 + np.pi)
    end = hall()[5].transform(inverse(true))
    sight = LinesOfSight.between([end], np.array([3.0]), [*hall(), screen])
    assert sight.blocked(true) == 0.0 and sight.blocked(wrong) == pytest.approx(3.0)
    assert LinesOfSight.between([end], np.array([3.0]), hall()).blocked(wrong) == 0.0


@pytest.mark.parametrize("lean", [-0.2, 0.2])
def test_a_hall_is_told_from_itself_turned_round_by_what_would_be_seen_through_a_screen(lean: float):
    """All that is seen has a partner either way; the expectation lies nearer to the wrong end, or to the right one."""
    rng, true, screen = np.random.default_rng(2), body(2.0, 0.5, 0.2), wall((5.0, 0.0, 1.5), (1.0, 0.0, 0.0), 8.0, 3.0)
    *along, _, near_end = hall(4.0)  # what is this side of the screen
    seen, expected = measured([*along, near_end], true, rng), body(0.0, 0.0, 0.2 + np.pi / 2.0 + lean)
    known = [plane.transform(inverse(expected)) for plane in [*hall(), screen]]
    found = register_planes_globally(seen, known, (2.0, 1.4))
    assert found is not None
    error = inverse(inverse(expected) @ true) @ found.known_T_seen
    assert np.linalg.norm(error[:3, 3]) < 0.02 and error[0, 0] > 0.9999


def test_a_body_is_not_turned_upside_down_by_a_room_that_fits_better_so():
    """A low cupboard was seen before, a high one is now; turned about the long axis of the room they are one."""
    long, wide, high = 6.0, 4.0, 3.0
    room = [
        wall((0.0, 0.0, -high / 2.0), (0.0, 0.0, 1.0), long, wide),
        wall((0.0, 0.0, high / 2.0), (0.0, 0.0, -1.0), long, wide),
        wall((0.0, wide / 2.0, 0.0), (0.0, -1.0, 0.0), long, high),
        wall((0.0, -wide / 2.0, 0.0), (0.0, 1.0, 0.0), long, high),
    ]
    low, high_up = (wall((long / 2.0, 0.0, z), (-1.0, 0.0, 0.0), wide, 0.6) for z in (-1.2, 1.2))
    true = body(0.3, 0.2, 0.1)
    true[2, 3] = 0.0
    known, seen = [*room, low], measured([*room, high_up], true, np.random.default_rng(4))
    tipped = np.diag((1.0, -1.0, -1.0, 1.0)) @ true
    shares = [_agreement(one, PlaneArrays.of(seen), PlaneArrays.of(known)) for one in (true, tipped)]
    assert shares[1] > shares[0] + 1.0
    found = register_planes_globally(seen, known, (10.0, 35.0))
    assert found is not None and np.abs(found.known_T_seen - true)[:3, :3].max() < 0.01
    _, anywhere = places_anywhere(seen, known)[0]  # of a map that may lie on its side nothing is known
    assert np.abs(anywhere.known_T_seen - tipped).max() < 0.05
