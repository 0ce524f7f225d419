"""What a map leaves open where nobody measured the motion; and its planes against each other: behind, or doubled."""

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
import pytest
from shapely import box

from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.diagnostics.evidence import coverage
from slam.diagnostics.evidence.coverage import assumption_evidence
from slam.diagnostics.evidence.surfaces import Surfaces, agreement, doubled_pairs, stopped_rays
from slam.diagnostics.verdict import Evidence
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from slam.loop_closure.pairwise_consistency import Proposal
from slam.loop_closure.verification import LoopDecision
from slam.registration.relocalization import Rivals
from slam.registration.submaps import PlanarPose
from slam.sensors.rig import Mount, Sensor
from spplanes import Plane
from tests.slam.registration.test_plane_registration import body, hall, measured, wall
from tests.slam.scenes import room_planes

CORRIDOR = [*hall()[:2], *hall()[4:]]  # nothing stands across y
UPRIGHT = (1e-3, 1e-3, 1e-3)


def driven(
    planes: list[Plane],
    *,
    odometry: bool,
    matched: bool = False,
    sigma: float = 0.01,
    refuted: Mapping[int, float] | None = None,
) -> PlaneSlam:
    """Ten keyframes along y, half a second and 0.3 m apart; `matched`: by scans, which tell the heading alone.

    Scans refute wheels at some keyframes, and leave the way along y there open by so much, m.
    """
    rng, slam = np.random.default_rng(0), PlaneSlam()
    bodies = [body(1.0, 0.3 * k, 0.0) for k in range(10)]
    for k, world_T_body in enumerate(bodies):
        motion, step = None, inverse(bodies[k - 1]) @ world_T_body
        by_scans = {"returns_a_T_b": step, "returns_covariance": np.diag((30.0, 30.0, 0.01)) ** 2}
        if odometry and k:
            motion = Motion(step, np.diag((sigma, sigma, 0.005)) ** 2, UPRIGHT)
        if matched and k:
            motion = Motion(step, np.diag((0.2, 0.2, 0.1)) ** 2, UPRIGHT, **by_scans)
        if refuted and k in refuted:
            motion = Motion(step, np.diag((0.15, refuted[k], 0.01)) ** 2, UPRIGHT, **by_scans, refuted_a_T_b=step)
        seen = [PlaneObservation(plane) for plane in measured(planes, world_T_body, rng)]
        slam.add_keyframe(Keyframe(k * 500_000_000, seen, motion))
    return slam


@pytest.mark.parametrize("matched", [False, True], ids=["planes", "scans"])
def test_a_bare_corridor_without_odometry_is_doubted(matched: bool) -> None:
    [found] = assumption_evidence(driven(CORRIDOR, odometry=False, matched=matched))
    assert (found.kind, found.grade, found.p_value) == ("assumption", "doubtful", 0.0)
    assert found.size > 0.1 and "along y" in found.sentence and 9 in found.keyframes


@pytest.mark.parametrize("planes, odometry", [(hall(), False), (CORRIDOR, True)], ids=["hall", "odometry"])
def test_what_is_seen_or_measured_is_no_assumption(planes: list[Plane], odometry: bool) -> None:
    assert not list(assumption_evidence(driven(planes, odometry=odometry)))


def test_a_few_short_assumptions_are_not_what_a_long_way_is_unsure_of() -> None:
    """Wheels leave 0.15 m open of a corridor; motions without wheels count where they alone add up to 0.1 m."""
    assert not list(assumption_evidence(driven(CORRIDOR, odometry=True, sigma=0.05, refuted={3: 0.04, 6: 0.04})))
    for refuted in ({3: 0.04, 5: 0.04, 6: 0.04}, {6: 0.12}):
        [found] = assumption_evidence(driven(CORRIDOR, odometry=True, sigma=0.05, refuted=refuted))
        assert min(found.keyframes) >= 6


@pytest.mark.parametrize("walls, blind", [([], 9), ([2], 0)], ids=["floor and ceiling", "one wall"])
def test_floors_and_ceilings_tell_nothing_of_where_on_the_floor_a_body_is(walls: list[int], blind: int) -> None:
    level = [plane for plane in hall() if abs(plane.normal[2]) > 0.99]
    assert len(level) == 2
    found = list(coverage.coverage_evidence(driven([*level, *(hall()[k] for k in walls)], odometry=True)))
    assert [one.size for one in found] == [blind] * bool(blind)


def test_places_that_fit_as_well_are_counted_together() -> None:
    def of(*probabilities: float) -> list[Evidence]:
        rivals = {3 + k: Rivals(p, 5.0 + k, np.pi) for k, p in enumerate(probabilities)}
        return list(coverage.ambiguity_evidence(SimpleNamespace(rivals=rivals)))  # type: ignore[arg-type]

    assert of() == of(0.0) == of(0.1, 0.1) == []
    [found] = of(0.2, 0.0, 0.5)
    assert found.size == pytest.approx(0.6) and found.keyframes == (3, 5) and found.grade == "doubtful"
    assert "7.0 m and 180 deg off at keyframe 5" in found.sentence and "probability 0.60" in found.sentence
    assert len(of(*[0.05] * 6)) == 1


def test_a_loop_that_waits_to_the_end_elsewhere_than_the_map_has_it_is_told() -> None:
    def of(verdict: str, *deltas: tuple[float, float, float]) -> list[Evidence]:
        poses = np.stack([planar_transform(float(k), 0.0, 0.0) for k in range(3)])
        found = [Proposal(2, 0, PlanarPose(np.array(d), np.eye(3)), k, 2.0) for k, d in enumerate(deltas)]
        loops = [LoopDecision(2, 0, verdict, (), 0.0, 0.0, proposal=one) for one in found]
        run = SimpleNamespace(loops=loops, trajectory=SimpleNamespace(poses=poses))
        return list(coverage.waiting_evidence(run))  # type: ignore[arg-type]

    assert of("waiting") == of("waiting", (2.0, 0.05, 0.3)) == of("known", (2.0, 0.4, 0.0)) == []
    [found] = of("waiting", (2.0, 0.05, 0.0), (2.0, 0.4, 0.0))
    assert found.size == pytest.approx(1.0 / (1.0 + np.exp(-1.0))) and found.keyframes == (0, 2)
    assert "at keyframe 2 fits what was seen at keyframe 0 better 0.4 m from where the map has it" in found.sentence


EYE = np.eye(4)
EYE[2, 3] = 1.5
CLOUD = Sensor(kind="cloud", body_T_sensor=Mount(xyz_m=(0.0, 0.0, 1.5)), range_sigma_m=0.01, range_max_m=30.0)


def surfaces_of(planes: list[Plane]) -> Surfaces:
    walls = tuple((plane.frame, plane.outline.buffer(-0.1)) for plane in planes if plane.outline is not None)
    return Surfaces(tuple(range(len(walls))), walls)  # type: ignore[arg-type]


def shifted(plane: Plane, along: float) -> Plane:
    frame = plane.frame.copy()
    frame[:3, 3] += along * plane.normal
    return Plane(frame, plane.covariance, plane.n_points, plane.outline)


def keyframe(pose: np.ndarray) -> Keyframe:
    return Keyframe(0, [PlaneObservation(plane.transform(inverse(pose))) for plane in room_planes()])


def test_from_its_true_pose_nothing_stops_a_ray_and_from_another_a_wall_does():
    pose, walls = planar_transform(1.0, 0.5, 0.3), surfaces_of(room_planes())
    assert not stopped_rays([keyframe(pose)], pose[None], walls, CLOUD)
    off = planar_transform(1.0, 1.5, 0.3)  # a metre to the left: one wall is seen a metre behind itself
    (behind,) = stopped_rays([keyframe(pose)], off[None], walls, CLOUD)
    assert room_planes()[behind].normal[1] < -0.9


@pytest.mark.parametrize("turn_rad, stopped_by", [(np.pi / 2.0, {1}), (0.2, set())])
def test_rays_of_a_slice_begin_where_the_body_was_when_it_passed(turn_rad: float, stopped_by: set[int]):
    """Of a wall beside the way a pillar hides what lies behind it from one place, not from beside it."""
    seen = wall((3.0, 3.0, 1.0), (0.0, -1.0, 0.0), 6.0, 2.0)
    pillar = wall((2.0, 1.5, 1.0), (-1.0, 0.0, 0.0), 2.0, 2.0)
    before = wall((3.0, 2.0, 1.0), (0.0, -1.0, 0.0), 6.0, 2.0)
    walls, frames = surfaces_of([pillar, before]), [Keyframe(0, [PlaneObservation(seen)])]
    mount = Mount(xyz_m=(0.0, 0.0, 1.0), rpy_deg=(0.0, float(np.rad2deg(turn_rad)), 0.0))
    told = {"body_T_sensor": mount, "range_sigma_m": 0.01, "range_max_m": 30.0}
    assert stopped_rays(frames, np.eye(4)[None], walls, Sensor(kind="cloud", **told)).keys() == {0, 1}
    assert stopped_rays(frames, np.eye(4)[None], walls, Sensor(kind="slice", **told)).keys() == stopped_by


def test_planes_agree_under_the_right_motion_only():
    first, second = planar_transform(0.0, 0.0, 0.0), planar_transform(0.8, 0.3, 0.4)
    here, there = ([plane.transform(inverse(pose)) for plane in room_planes()] for pose in (first, second))
    assert agreement(here, there, inverse(first) @ second, EYE) == (6, 0)
    confirmed, through = agreement(here, there, inverse(first) @ second @ planar_transform(-1.0, 0.5, 0.0), EYE)
    assert confirmed <= 4 and through >= 1


def test_a_surface_that_is_there_twice_is_counted_once_and_a_wall_behind_another_is_not():
    room = room_planes()
    assert doubled_pairs(surfaces_of(room)) == []
    twice = surfaces_of([*room, shifted(room[2], 0.07), shifted(room[4], 0.8), shifted(room[5], 0.005)])
    ((large, small, gap),) = doubled_pairs(twice)
    assert {large, small} == {2, 6} and abs(abs(gap) - 0.07) < 1e-9


def test_a_board_beside_a_wall_does_not_double_it():
    wall = room_planes()[4]
    beside = Plane(shifted(wall, 0.05).frame, wall.covariance, 100, box(3.8, -1.0, 6.8, 1.0))
    assert doubled_pairs(surfaces_of([wall, beside])) == []
