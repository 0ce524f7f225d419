"""The joint covariance of a map's planes: its blocks, its derivatives, and how sure it makes the rooms of offices."""

from collections.abc import Iterable
from functools import partial
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from slam.floorplan import FloorPlan, joint_planes
from slam.mapping.same_plane import hesse_of
from slam.planeslam import PlaneSlam
from tests.slam.floorplan.measured_suites import Measured, mapped, nees_of, pairs_of, plan_of
from tests.statistics import assert_jacobian, mean_nees_band


@pytest.fixture(scope="module")
def suites() -> list[Measured]:
    return [Measured.of(seed, spacing_m=0.8, rooms_a_side=1) for seed in range(3)]


@pytest.fixture(scope="module")
def maps(suites: list[Measured]) -> list[PlaneSlam]:
    return [mapped(one.drawn()) for one in suites]


def state_at(slam: PlaneSlam, landmark, step: np.ndarray) -> SimpleNamespace:
    """With one landmark and its anchor moved by tangents."""
    pose = gtsam.Pose3(slam.backend.pose(landmark.anchor_key)).retract(step[3:]).matrix()
    plane = slam.backend.plane(landmark.key).retract(step[:3])
    return SimpleNamespace(pose=lambda key: pose, plane=lambda key: plane)


def test_planes_in_the_world_by_central_differences(maps: list[PlaneSlam]):
    slam = maps[0]

    def hesse(landmark, step: np.ndarray) -> np.ndarray:
        normal, d, _, _ = hesse_of(landmark, state_at(slam, landmark, step))  # type: ignore
        return np.append(normal, d)

    for landmark in slam.landmarks:
        _, _, jacobian, keys = hesse_of(landmark, slam.backend)
        assert keys == [landmark.key, landmark.anchor_key]
        assert_jacobian(partial(hesse, landmark), np.zeros(9), jacobian, atol=1e-7)


def test_blocks_are_the_covariances_of_the_map(maps: list[PlaneSlam]):
    slam = maps[0]
    joint = joint_planes(slam.planes, slam.landmarks, slam.backend)
    for k, one in enumerate(slam.planes):
        block = joint.covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]
        np.testing.assert_allclose(block, one.plane.hesse_covariance, rtol=1e-4, atol=1e-12)
        np.testing.assert_allclose(joint.hesse[k], [*one.plane.normal, one.plane.d], atol=1e-9)
    assert np.linalg.eigvalsh(joint.covariance).min() > -1e-12


def assert_as_sure_as_they_say(found: Iterable[tuple[Measured, FloorPlan]]) -> None:
    """Errors of all measures of a kind, over what is claimed of them."""
    total: dict[str, np.ndarray] = {}
    for measured, plan in found:
        for kind, pairs in pairs_of(measured.suite, plan).items():
            total[kind] = total.get(kind, np.zeros(2)) + nees_of(plan.joint, pairs)
    for kind, (nees, dof) in total.items():
        low, high = mean_nees_band(1, int(dof))
        assert low <= nees <= high, f"{kind}: {nees:.1f} of {dof} outside [{low:.1f}, {high:.1f}]"


def test_measures_of_offices_are_as_sure_as_they_say(suites: list[Measured], maps: list[PlaneSlam]):
    """Of observations whose covariance is right."""
    plans = [plan_of(slam) for slam in maps]
    for plan in plans:
        assert len(plan.storeys[0].rooms) == 3
        assert len(plan.storeys[0].openings) == 2
    assert_as_sure_as_they_say(zip(suites, plans, strict=True))


def test_measures_of_offices_as_they_were_segmented_are_as_sure_as_they_say():
    """End to end with a laser of 15 mm, of which most goes wrong where planes end: heights, with those ends, by 2.8."""
    suites = (Measured.of(seed, range_sigma_m=0.015, spacing_m=0.8, rooms_a_side=1) for seed in range(4))
    assert_as_sure_as_they_say((measured, plan_of(mapped(measured.keyframes))) for measured in suites)


def test_no_planes_have_no_covariance():
    slam = PlaneSlam()
    assert joint_planes([], slam.landmarks, slam.backend).covariance.shape == (0, 0)
