"""Floor plans of buildings that are exactly known."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from slam.floorplan import JointPlanes, floor_plan
from slam.floorplan.plan import StoreyPlan
from slam.geometry.frames import planar_transform
from slam.simulation.world import WorldBuilder
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.slam.floorplan.buildings import joint_of, moved, planes_of
from tests.statistics import assert_mean_in_band

#: Variances below this share of the largest are of what is zero to first order: differences of opposite sides.
RANK = 1e-4


def only(joint: JointPlanes) -> StoreyPlan:
    (storey,) = floor_plan(joint).storeys
    return storey


def areas(plan: StoreyPlan) -> list[float]:
    return sorted(room.area.value for room in plan.rooms)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> list[Plane]:
    builder = WorldBuilder()
    builder.add_box(low, high)
    return builder.build().planes


def is_face(plane: Plane, axis: int, at: float) -> bool:
    return abs(abs(plane.normal[axis]) - 1.0) < 1e-9 and abs(plane.centre[axis] - at) < 1e-9


def test_of_what_has_no_walls_there_is_no_plan():
    """Once the picture of nothing ended in numpy's sentence on arrays to concatenate."""
    ceiling = [plane for plane in planes_of() if abs(plane.normal[2]) > 0.9]
    low = [plane for plane in box((1.0, -0.5, 0.0), (2.0, 0.5, 0.9)) if abs(plane.normal[2]) < 0.1]
    assert low and len(ceiling) > 1
    with pytest.raises(ValueError, match="expected at least one vertical plane for a floor plan, got none"):
        floor_plan(joint_of(ceiling))
    with pytest.raises(ValueError, match="expected a wall that reaches the ceiling for a floor plan, got none"):
        floor_plan(joint_of([*ceiling, *low]))


def test_a_suite_is_measured():
    plan = only(joint_of(planes_of()))
    assert areas(plan) == pytest.approx([12.0, 12.0, 17.5])
    assert all(len(room.rings) == 1 and len(room.rings[0]) == 4 and len(room.widths) == 2 for room in plan.rooms)
    assert [room.height.value for room in plan.rooms if room.height] == pytest.approx([2.5] * 3)
    largest = plan.rooms[0]
    assert sorted(one.distance.value for one in largest.widths) == pytest.approx([3.5, 5.0])
    assert sorted(side.length.value for side in largest.rings[0]) == pytest.approx([3.5, 3.5, 5.0, 5.0])
    assert [wall.thickness.value for wall in plan.walls] == pytest.approx([0.2, 0.2])
    assert sorted(one.width.value for one in plan.openings if one.width) == pytest.approx([0.9, 1.0])
    assert [one.height.value for one in plan.openings if one.height] == pytest.approx([2.05, 2.05])
    assert all(one.wall in plan.walls and one.sill is None for one in plan.openings)
    solids = shapely.union_all([shapely.Polygon(plan.storey.in_plan(wall.outline)) for wall in plan.walls])
    assert solids.area == pytest.approx(0.2 * (4.0 + 5.0))


def test_a_tilted_world_gives_the_same_plan():
    """A first pose that is not level: the floor says what is upright."""
    tilt = transform_from_rpy((5.0, 2.0, 1.0, *np.deg2rad((30.0, -7.0, 12.0))))
    tilted = only(joint_of([one.transform(tilt) for one in planes_of()]))
    assert areas(tilted) == pytest.approx(areas(only(joint_of(planes_of()))), abs=1e-9)
    assert len(tilted.openings) == 2


def test_errors_of_planes_are_those_of_the_measures():
    """Planes drawn from the joint covariance: errors of all measures of a kind are chi2 with theirs."""
    joint, rng = joint_of(planes_of(), sigma=2e-3), np.random.default_rng(0)
    vectors, values, _ = np.linalg.svd(joint.covariance)
    draws = vectors * np.sqrt(values) @ rng.standard_normal((len(values), 60))
    drawn = [measures(only(moved(joint, draw.reshape(-1, 4)))) for draw in draws.T]
    for kind, true in measures(only(joint)).items():
        errors = np.array([[one.value for one in found[kind]] for found in drawn]) - [one.value for one in true]
        covariance = joint.covariance_of(true)
        inverse = np.linalg.pinv(covariance, rcond=RANK, hermitian=True)
        dof = np.linalg.matrix_rank(covariance, tol=RANK * np.linalg.norm(covariance, 2), hermitian=True)
        assert_mean_in_band(np.einsum("ni,ij,nj->n", errors, inverse, errors), int(dof))


def measures(plan: StoreyPlan) -> dict[str, list]:
    rooms = sorted(plan.rooms, key=lambda room: tuple(np.round(room.middle, 1)))
    widths = [sorted(room.widths, key=lambda one: abs(one.second - one.first)[0]) for room in rooms]
    sides = [sorted(room.sides, key=lambda one: tuple(np.round(one.face.normal, 1))) for room in rooms]
    openings = sorted(plan.openings, key=lambda one: round(float(one.outline[0, 0]), 1))
    walls = sorted(plan.walls, key=lambda one: round(float(one.outline[0, 1]), 1))
    return {
        "areas": [room.area for room in rooms],
        "widths": [one.distance for ones in widths for one in ones],
        "heights": [room.height for room in rooms[:1]],
        "lengths": [side.length for ring in sides for side in ring],
        "openings": [one.width for one in openings] + [one.thickness for one in walls],
    }


def test_storeys_are_told_apart_by_height():
    lower, upper = floor_plan(joint_of(planes_of() + planes_of(floor_m=2.9))).storeys
    assert [len(one.rooms) for one in (lower, upper)] == [3, 3]
    assert lower.elevation is not None and lower.elevation.sigma == 0.0
    assert upper.elevation is not None and upper.elevation.value == pytest.approx(2.9) and upper.elevation.sigma > 0.0
    assert [room.height.value for room in upper.rooms if room.height] == pytest.approx([2.5] * 3)


def test_a_wall_through_two_storeys_is_in_both():
    tall = box((0.0, 0.0, 0.0), (4.0, 3.0, 5.4))
    inside = [Plane(one.frame @ np.diag([1.0, -1.0, -1.0, 1.0]), one.covariance, 5, one.outline) for one in tall]
    slab = box((0.0, 0.0, 2.5), (4.0, 3.0, 2.9))
    levels = [one for one in slab if abs(one.normal[2]) > 0.9]
    lower, upper = floor_plan(joint_of(inside + levels)).storeys
    assert [room.area.value for room in (*lower.rooms, *upper.rooms)] == pytest.approx([12.0, 12.0])
    assert [room.height.value for room in (*lower.rooms, *upper.rooms) if room.height] == pytest.approx([2.5, 2.5])


def test_what_does_not_reach_the_ceiling_is_no_wall_and_a_pillar_is_a_hole_in_its_room():
    closet, pillar = box((0.4, 3.6, 0.0), (2.0, 4.2, 2.0)), box((2.0, -3.5, 0.0), (2.8, -2.7, 2.5))
    assert areas(only(joint_of(planes_of() + closet))) == pytest.approx([12.0, 12.0, 17.5])
    plan = only(joint_of(planes_of() + [one for one in pillar if not one.normal[2]]))
    (room,) = [room for room in plan.rooms if len(room.rings) == 2]
    assert room.area.value == pytest.approx(17.5 - 0.64)


def test_a_room_whose_wall_was_not_seen_is_not_named():
    planes = [one for one in planes_of() if not is_face(one, 1, 4.2)]
    assert len(planes) == len(planes_of()) - 1
    plan = only(joint_of(planes))
    assert areas(plan) == pytest.approx([12.0, 17.5])
    assert all(room.middle[1] < 1.2 for room in plan.rooms)


def test_a_wall_seen_from_one_side_has_no_thickness():
    """The upper room was never entered: no room, no wall, and its jambs alone tell of the door."""
    planes = [one for one in planes_of() if one.centre[1] < 1.15 or abs(one.normal[2]) > 0.9]
    plan = only(joint_of(planes))
    assert len(plan.walls) == 1
    single = [face for face, _ in plan.single if is_face(planes[face.plane], 1, 1.0)]
    assert len(single) == 1
    door = next(one for one in plan.openings if one.face is single[0])
    assert door.wall is None and door.width is not None and door.width.value == pytest.approx(0.9)
    assert door.depth_m == pytest.approx(0.2)


def test_without_jambs_an_opening_has_no_measured_width():
    jambs = {1.0, 1.9, 3.0, 4.0}
    planes = [p for p in planes_of() if not (abs(p.normal[0]) > 0.9 and any(is_face(p, 0, x) for x in jambs)
                                             and p.outline is not None and p.outline.area < 0.5)]  # fmt: skip
    assert len(planes) == len(planes_of()) - 4
    openings = only(joint_of(planes)).openings
    assert [one.width for one in openings] == [None, None]
    assert sorted(one.span[1] - one.span[0] for one in openings) == pytest.approx([0.9, 1.0])


def test_faces_that_are_not_parallel_are_not_of_one_wall():
    """An angle of 2 degrees is beyond noise and building; within the noise of planes that are badly known it is not."""
    turned = planar_transform(0.0, 0.0, np.deg2rad(2.0))
    planes = [one.transform(turned) if is_face(one, 1, 1.2) else one for one in planes_of()]
    assert len(only(joint_of(planes, sigma=1e-4)).walls) == 1
    assert len(only(joint_of(planes, sigma=5e-2)).walls) == 2


def test_a_level_laser_alone_gives_rooms_without_height():
    """Lines in place of polygons, neither floor nor ceiling."""
    joint, lines = joint_of([one for one in planes_of() if abs(one.normal[2]) < 0.1]), []
    for one in joint.planes:
        up, there = one.plane.frame[2, :2], one.plane.frame[2, 3]  # height of (x, y): there + up.(x, y)
        across = np.array([[-9.0, 9.0], [9.0, -9.0]]) @ np.diag([up[1], up[0]]) + (1.3 - there) * up
        lines.append(replace(one, seen=shapely.intersection(one.seen, shapely.LineString(across)), kinds=("line",)))
    plan = only(JointPlanes(tuple(lines), joint.hesse, joint.covariance))
    assert plan.elevation is None and areas(plan) == pytest.approx([12.0, 12.0, 17.5])
    assert [room.height for room in plan.rooms] == [None] * 3
