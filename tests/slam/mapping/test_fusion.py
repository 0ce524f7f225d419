"""A wrong merge is found by what is seen afterwards and taken back; the map is then as if it had never been."""

import numpy as np
import pytest

from slam import PlaneSlam
from slam.geometry.frames import inverse
from slam.mapping.same_plane import same_plane_chi2
from slam.planeslam import pose_symbol
from spplanes import Plane
from tests.slam.scenes import drive, run_of


def planes_by_direction(slam: PlaneSlam) -> list[Plane]:
    return sorted((one.plane for one in slam.planes), key=lambda plane: tuple(np.round(plane.normal, 1)))


def assert_same_map(found: PlaneSlam, wanted: PlaneSlam, *, outlines: float = 0.05) -> None:
    np.testing.assert_allclose(found.trajectory.poses, wanted.trajectory.poses, atol=2e-4)
    assert [one.observations for one in found.planes] == [one.observations for one in wanted.planes]
    for one, other in zip(planes_by_direction(found), planes_by_direction(wanted), strict=True):
        np.testing.assert_allclose(one.normal, other.normal, atol=2e-4)
        assert one.d == pytest.approx(other.d, abs=2e-4)
        scale = np.sqrt(np.outer(np.diag(other.covariance), np.diag(other.covariance)))
        np.testing.assert_allclose(one.covariance / scale, other.covariance / scale, atol=0.01)
        assert one.n_points == other.n_points and one.outline is not None and other.outline is not None
        assert one.outline.area == pytest.approx(other.outline.area, rel=outlines)


def test_a_merge_undone_leaves_the_map_as_if_it_had_never_been():
    scene = drive(0)
    slam, untouched = run_of(scene.keyframes), run_of(scene.keyframes)
    merge = slam.merges.merge(2, 4, "same plane")
    assert len(slam.landmarks) == 5 and np.abs(slam.trajectory.poses - untouched.trajectory.poses).max() > 0.05
    slam.merges.undo(merge)
    assert merge.undone == len(scene.keyframes) - 1
    assert_same_map(slam, untouched)
    assert not slam.merges.may_be_one(2, 4)


def test_what_was_seen_after_the_merge_goes_to_whom_it_fits():
    scene = drive(1)
    slam = run_of(scene.keyframes[:8])
    merge = slam.merges.merge(2, 4, "same plane")
    merge.next_look = 10**6  # let it stand for a while: everything seen of either is matched to what is there
    run_of(scene.keyframes[8:], slam)
    slam.merges.undo(merge)
    for landmark in slam.landmarks:  # the scene lists the planes in the same order in every keyframe
        assert len({sighting.observation for sighting in landmark.sightings}) == 1


def test_a_wrong_merge_is_found_by_its_residuals_and_split():
    scene = drive(2)
    slam = run_of(scene.keyframes[:8])
    merge = slam.merges.merge(2, 5, "same plane")
    run_of(scene.keyframes[8:], slam)
    assert merge.undone == 8 and same_plane_chi2(slam.landmarks[2], slam.landmarks[5], slam.backend) > 1e3
    # the keyframe in between was compared with a bent map: what it saw is lost, nothing else
    assert [one.observations for one in slam.planes] >= [14] * 6
    np.testing.assert_allclose(slam.trajectory.poses, run_of(scene.keyframes).trajectory.poses, atol=0.01)


def test_a_chain_of_merges_can_be_undone_from_its_first_link():
    scene = drive(4)
    slam, untouched = run_of(scene.keyframes), run_of(scene.keyframes)
    merges = [slam.merges.merge(*pair, "same plane") for pair in ((2, 4), (1, 2))]
    for merge in reversed(merges):
        slam.merges.undo(merge)
    for one in (slam, untouched):
        one.backend.settle(5)
    assert_same_map(slam, untouched, outlines=0.5)  # the second's is drawn while the first still bends the way
    first = slam.merges.merge(2, 4, "same plane")
    slam.merges.merge(1, 2, "same plane")
    slam.merges.undo(first)
    assert {one.id for one in slam.landmarks} == {0, 1, 3, 4, 5}
    assert len({sighting.observation for sighting in slam.landmarks[4].sightings}) == 1
    assert slam.landmarks[4].n_keyframes == 15


def test_a_false_closure_is_refused_by_the_graph_and_leaves_no_trace():
    scene = drive(5)
    slam, untouched = run_of(scene.keyframes), run_of(scene.keyframes)
    assert not slam.merges.close([(2, 4), (3, 5)], 1.0)
    assert_same_map(slam, untouched)
    assert slam.merges.history == [] and not slam.merges.may_be_one(2, 4) and not slam.merges.may_be_one(3, 5)
    for keyframe in drive(5, count=20, turns=0.95).keyframes[15:]:  # what comes after is bit for bit the same, too
        for one in (slam, untouched):
            one.add_keyframe(keyframe)
    assert np.array_equal(slam.trajectory.poses, untouched.trajectory.poses)


def test_a_true_closure_stands():
    """On a drive whose later half names every plane anew, as after a drift that association does not bridge."""
    scene = drive(6)
    slam = run_of(scene.keyframes[:8])
    hidden = [slam.landmarks.remove(one.id) for one in list(slam.landmarks)]
    slam.landmarks.refresh(slam.backend)
    run_of(scene.keyframes[8:], slam)
    for landmark in hidden:
        slam.landmarks.plant(landmark)
    slam.landmarks.refresh(slam.backend)
    assert len(slam.landmarks) == 12
    old, new = (sorted(one.id for one in slam.landmarks if (one.id < 6) == early) for early in (True, False))
    known = slam.landmarks
    pairs = [(a, min(new, key=lambda b, a=a: same_plane_chi2(known[a], known[b], slam.backend))) for a in old]
    assert slam.merges.close(pairs, 1.0) and len(slam.landmarks) == 6
    for merge in slam.merges.history:
        merge.next_look = 0
    assert slam.merges.doubted({one.id for one in slam.landmarks}, 1.0) == []
    assert np.linalg.norm((inverse(scene.world_T_body[-1]) @ slam.trajectory.poses[-1])[:3, 3]) < 0.02
    assert np.isfinite(slam.marginal_covariance(pose_symbol(14))).all()


def test_every_decision_can_be_explained_with_its_numbers():
    slam = run_of(drive(8).keyframes)
    first, last = slam.explain(0), slam.explain(14)
    assert first[0] == "plane 0 (500 points) is none of the landmarks: no landmark near"
    match = slam.decisions[14][0].match
    assert match is not None
    assert last[0].startswith(f"plane 0 (500 points) is landmark {match.landmark}: landmark {match.landmark} chi2 ")
    assert f"chi2 {match.chi2:.1f} of 3 dof" in last[0]
    slam.merges.undo(slam.merges.merge(2, 4, "loop"))
    assert slam.explain(14)[-2:] == [
        "landmark 4 became part of landmark 2 (loop)",
        "landmark 4 was found not to be landmark 2 after all",
    ]
    with pytest.raises(ValueError, match="keyframe: expected an index from 0 to 14, got 15"):
        slam.explain(15)
