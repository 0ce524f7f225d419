"""Joined maps: honest about planes, poses and frames; what is not one is kept apart; what is not sure is not joined."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factors.association.observations import PlaneObservation
from slam.config import SlamConfig
from slam.geometry.frames import inverse, planar_transform
from slam.joining import FinishedMission, JoinedMap, join
from slam.joining.join import names_of
from slam.joining.overlap import compare_missions
from slam.joining.solution import base_key
from slam.map.map_planes import MapPlane
from spplanes import Plane
from tests.slam.joining.missions import first, room_T_second, scene, second, second_of
from tests.slam.scenes import drive, planar_nees, room_planes
from tests.statistics import assert_mean_in_band

#: Pairs of missions: of 3 dof twice or half a covariance is off the band in 84 and 71 of 100, of 12 dof always.
RUNS = 16


def about(seed: int) -> np.ndarray:
    """A guess 0.2 m and 0.05 rad off: the room looks the same from both ends."""
    return room_T_second(seed) @ planar_transform(0.2, -0.1, 0.05)


@cache
def joined(seed: int) -> JoinedMap:
    return join([first(seed), second(seed)], guesses={("first", "second"): about(seed)})


def plane_of(one: FinishedMission, landmark: int) -> MapPlane:
    return next(known for known in one.mission.planes if known.id == landmark)


def test_joined_planes_poses_and_frames_are_honest():
    """NEES of planes, of the second mission's frame and of its last pose, 3 dof each."""
    planes, frames, poses = [], [], []
    for seed in range(RUNS):
        component = joined(seed).components[0]
        assert component.names == ("first", "second") and sorted(len(places) for places in component.classes) == [2] * 6
        found = [one.plane for one in component.planes]
        true = [max(room_planes(), key=lambda one, mine=mine: one.normal @ mine.normal) for mine in found]
        planes.append(np.mean([mine.mahalanobis(one) for mine, one in zip(found, true, strict=True)]))
        spread = component.solution.posterior(1)._marginal([base_key(1)]).covariance([base_key(1)])
        frames.append(planar_nees(spread, room_T_second(seed), component.common_T_mission["second"]))
        last = component.trajectories["second"].poses[-1]
        poses.append(planar_nees(component.pose_covariance(1, 14), scene(1000 + seed).world_T_body[-1], last))
    for found in (planes, frames, poses):
        assert_mean_in_band(np.array(found), 3)


def test_a_room_that_looks_the_same_from_both_ends_is_not_joined_without_a_guess():
    found = join([first(0), second(0)])
    assert [one.names for one in found.components] == [("first",), ("second",)] and found.alone == ["first", "second"]
    assert found.comparisons[0].verdict in ("ambiguous", "unobservable", "not seen")


def test_a_guess_that_is_wrong_joins_nothing():
    """By 2 m along the room, four standard deviations."""
    far = room_T_second(0) @ planar_transform(2.0, 0.0, 0.0)
    found = join([first(0), second(0)], guesses={("first", "second"): far})
    assert found.comparisons[0].verdict in ("refused", "not seen") and len(found.components) == 2


def test_a_guess_may_be_given_the_other_way_round():
    turned = join([first(0), second(0)], guesses={("second", "first"): inverse(about(0))})
    np.testing.assert_allclose(turned.planes[0].plane.frame, joined(0).planes[0].plane.frame, atol=1e-9)


def test_what_has_moved_between_the_missions_is_kept_apart_and_told():
    """The second mission sees the wall at x = 4 nearer by 0.15 m: some forty standard deviations."""
    shifted = []
    for keyframe, pose in zip(drive(1000).keyframes, scene(1000).world_T_body, strict=True):
        seen = list(keyframe.observations)
        assert isinstance(seen[3], PlaneObservation)
        plane, frame = seen[3].plane, seen[3].plane.frame.copy()
        frame[:3, 3] += 0.15 * frame[:3, 2]
        seen[3] = PlaneObservation(Plane(frame, plane.covariance, plane.n_points, plane.outline))
        shifted.append(replace(keyframe, observations=seen))
        assert np.allclose(pose[:3, :3] @ frame[:3, 2], [-1, 0, 0], atol=0.1)
    other = second_of(shifted)
    found = join([first(0), other], guesses={("first", "second"): about(0)})
    one, component = found.comparisons[0], found.components[0]
    assert one.verdict == "joined"
    [(i, j)] = one.moved
    mine, _ = plane_of(first(0), i).plane.normal, plane_of(other, j)
    np.testing.assert_allclose(np.abs(mine), [1, 0, 0], atol=0.01)  # of two walls across x either may have moved
    assert sorted(len(places) for places in component.classes) == [1, 1, 2, 2, 2, 2, 2]
    apart = [p.plane.d for p in component.planes if p.plane.normal @ mine > 0.9]
    np.testing.assert_allclose(max(apart) - min(apart), 0.15, atol=0.02)


def test_chi2_of_the_common_planes_is_chi2():
    """Six planes, 12 dof."""
    values = [
        compare_missions(first(s).mission, second(s).mission, SlamConfig(), significance=1e-3, guess=about(s)).alignment
        for s in range(RUNS)
    ]
    assert all(one is not None and one.n_dof == 12 for one in values)
    assert_mean_in_band(np.array([one.chi2 for one in values if one is not None]), 12)


def test_a_guess_of_a_run_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="expected names of runs, first, second, got first, nobody"):
        join([first(0), second(0)], guesses={("first", "nobody"): np.eye(4)})


def test_names_tell_runs_apart():
    assert names_of(["a/monday", "a/tuesday"]) == ["monday", "tuesday"]
    assert names_of(["/x/a/run", "/x/b/run"]) == ["a-run", "b-run"]
