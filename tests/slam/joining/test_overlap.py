"""Overlaps of simulated offices: one building is found again from elsewhere, different ones are kept apart."""

from dataclasses import replace
from itertools import combinations

import gtsam
import numpy as np

from slam.config import SlamConfig
from slam.geometry.frames import inverse, planar_transform
from slam.joining import join
from slam.joining.alignment import align, whitened_differences
from slam.joining.consistency import components_of, consistent
from slam.joining.overlap import Comparison, compare_missions, free_space
from tests.slam.joining.missions import first, office, room_T_second, second, visit
from tests.slam.scenes import planar_nees
from tests.statistics import assert_jacobian

SEEDS = (0, 1, 2)


def building_T(seed: int, number: int) -> np.ndarray:
    return visit(seed, number).truth.poses_at(office(seed, number).mission.trajectory.stamps_ns[:1])[0]


def test_visits_of_one_building_are_joined_with_no_common_start():
    """Three visits of two buildings, half overlapping; the frames found are true within their covariance."""
    for seed in SEEDS[:2]:
        found = join([office(seed, number) for number in range(3)])
        assert len(found.components[0].names) == 3, [one.to_dict()["reason"] for one in found.comparisons]
        for one in (one for one in found.comparisons if one.verdict == "joined" and one.alignment is not None):
            a, b = int(one.first[-1]), int(one.second[-1])
            truth = inverse(building_T(seed, a)) @ building_T(seed, b)
            assert planar_nees(one.alignment.covariance, truth, one.alignment.a_T_b) < 21.1  # chi2, 3 dof, 1e-4


def test_different_buildings_are_not_joined():
    """Three pairs of three; `python -m benchmarks joins` has a thousand."""
    for a, b in combinations(SEEDS, 2):
        found = compare_missions(office(a).mission, office(b).mission, SlamConfig(), significance=1e-3)
        assert found.verdict != "joined"


def test_free_space_speaks_against_another_place():
    """Where a mission is laid two metres beside its place, looks go through walls."""
    a, b = office(0, 0).mission, office(0, 1).mission
    truth = inverse(building_T(0, 0)) @ building_T(0, 1)
    looks, through = free_space(a, b, truth)
    assert looks > 200 and through < 0.02 * looks
    looks, through = free_space(a, b, truth @ planar_transform(2.0, 1.0, 0.0))
    assert through > 0.2 * looks


def test_an_alignment_is_where_its_chi2_is_least():
    """The gradient of chi2 by the motion vanishes there, by central differences."""
    a, b, truth = first(0).mission, second(0).mission, room_T_second(0)
    pairs = [
        (i, j)
        for i, mine in enumerate(a.planes)
        for j, other in enumerate(b.planes)
        if mine.plane.normal @ truth[:3, :3] @ other.plane.normal > 0.9
    ]
    found = align(a, b, pairs, truth @ planar_transform(0.3, -0.2, 0.1))
    np.testing.assert_allclose(align(a, b, pairs, truth).a_T_b, found.a_T_b, atol=1e-4)

    def chi2(step: np.ndarray) -> np.ndarray:
        residual, _ = whitened_differences(a, b, pairs, found.a_T_b @ gtsam.Pose3.Expmap(step).matrix())
        return np.array([residual @ residual])

    scales = np.sqrt(np.diag(found.covariance))
    assert_jacobian(lambda x: chi2(x * scales), np.zeros(6), np.zeros((1, 6)), step=0.1, atol=0.05)
    assert chi2(np.eye(6)[2] * 3.0 * scales[2])[0] > found.chi2 + 8.0


def test_an_overlap_that_contradicts_a_loop_is_taken_back():
    """Of three missions in a ring the link with the least evidence is wrong by a metre."""
    a, b = first(0).mission, second(0).mission
    pairs = compare_missions(a, b, SlamConfig(), significance=1e-3, guess=room_T_second(0)).alignment
    assert pairs is not None

    def link(one: str, other: str, pose: np.ndarray, evidence: float) -> Comparison:
        return Comparison(one, other, "joined", "", replace(pairs, a_T_b=pose), evidence)

    step = planar_transform(2.0, 1.0, 0.3)
    ring = [link("a", "b", step, 30.0), link("b", "c", step, 20.0), link("a", "c", step @ step, 10.0)]
    assert [one.verdict for one in consistent(ring, 1e-6)] == ["joined"] * 3
    told = consistent([*ring[:2], link("a", "c", step @ step @ planar_transform(1.0, 0.0, 0.0), 10.0)], 1e-6)
    assert [one.verdict for one in told] == ["joined", "joined", "revoked"]
    assert "contradicts the way over other missions" in told[2].reason
    (component,) = components_of(["a", "b", "c"], told)
    np.testing.assert_allclose(component.common_T_mission["c"], step @ step, atol=1e-12)
    apart = components_of(["a", "b", "c"], [told[0], replace(told[1], verdict="refused")])
    assert [one.missions for one in apart] == [("a", "b"), ("c",)]
