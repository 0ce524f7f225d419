"""What a camera's calibration leaves open: its effect on a plane, by points; and covariances that hold with it."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.backend.estimator import pose_symbol
from slam.sensors.rig import RangeWarp
from spplanes import Location, Plane
from spplanes._check import FloatArray
from tests.slam.scenes import drive, planar_nees, room_planes, run_of
from tests.statistics import assert_mean_in_band


def open_by(covariance: FloatArray) -> RangeWarp:
    """A camera without a warp, of which that is open."""
    return RangeWarp(shares=((0.0,),), shares_per_m=((0.0,),), left_open=covariance.tolist())


@pytest.mark.parametrize("seed", range(4))
def test_the_effect_on_a_plane_is_that_on_its_points(seed: int) -> None:
    """Points all over half a metre of it, each moved along its ray, and the plane through them by least squares."""
    rng = np.random.default_rng(seed)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(rng=rng).as_matrix()
    frame[:3, 3] = np.array((0.0, 0.0, 3.0)) + rng.uniform(-1.0, 1.0, 3)
    share = 1e-4 * rng.standard_normal(3)
    local = np.column_stack((rng.uniform(-0.25, 0.25, (2000, 2)), np.zeros(2000)))
    local -= local.mean(axis=0)
    points = local @ frame[:3, :3].T + frame[:3, 3]
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    off = (points * (rays @ share)[:, None]) @ frame[:3, 2]
    design = np.column_stack((np.ones(2000), -local[:, 0], local[:, 1]))
    moved = np.linalg.lstsq(design, off, rcond=None)[0]
    effect = open_by(np.outer(share, share)).effect_on(frame)
    scale = np.sqrt(np.outer(moved**2, moved**2)).max()
    np.testing.assert_allclose(effect @ effect.T, np.outer(moved, moved), atol=0.03 * scale)


def seen_falsely(
    keyframes: list[Keyframe], names: tuple[str, ...], covariance: FloatArray, errors: FloatArray
) -> list[Keyframe]:
    """What cameras see of which a share is open, by errors of variance 1 (C, 3): every other plane by each of them."""
    warp, found = open_by(covariance), []
    for frame in keyframes:
        planes = [one.plane for one in frame.observations if isinstance(one, PlaneObservation)]
        seen = []
        for number, plane in enumerate(planes):
            camera = number % len(names)
            effect = warp.effect_on(plane.frame)
            moved = Location.plane(plane.frame, plane.covariance).perturbed(effect @ errors[camera]).transform
            false = Plane(moved, plane.covariance, plane.n_points, plane.outline)
            seen.append(PlaneObservation(false, calibration_effect=effect, sensor=names[camera]))
        found.append(replace(frame, observations=seen))
    return found


@pytest.mark.parametrize(("names", "share", "times"), [(("camera",), 0.002, 3.0), (("front", "rear"), 0.001, 1.4)])
def test_poses_and_planes_are_honest_though_no_error_averages_out(
    names: tuple[str, ...], share: float, times: float
) -> None:
    """NEES of the last pose and of all planes, in its band; without what is open it is so many times as large."""
    poses, planes, without = [], [], []
    for seed in range(24):
        errors, scene = np.random.default_rng(seed).standard_normal((2, 3)), drive(seed)
        slam = run_of(seen_falsely(scene.keyframes, names, share**2 * np.eye(3), errors))
        key, estimate = pose_symbol(14), slam.trajectory.poses[14]
        poses.append(planar_nees(slam.marginal_covariance(key), scene.world_T_body[14], estimate))
        assert len(slam.planes) == 6
        without.append(planar_nees(slam.backend.covariance(key), scene.world_T_body[14], estimate))
        planes.append(np.mean([nees_of(one.plane) for one in slam.planes]))
    assert_mean_in_band(np.array(poses), 3)
    assert 2.0 < np.mean(planes) < 4.0  # six planes of one error are no six draws
    assert np.mean(without) > 3.0 * times


@pytest.mark.parametrize("names", [("camera",), ("front", "rear")])
def test_covariances_have_what_runs_with_other_errors_say(names: tuple[str, ...]) -> None:
    """The graph's chi2 and the last pose by the errors, from differences; of each camera one error, a real one of -0.9.

    chi2(s) = const + 2 l s + s^T L s, of planes that errors s have moved.
    """
    scene, share, step = drive(5), np.array((1e-3, 5e-4, -5e-4)), 0.2
    units = np.zeros((len(names), len(names), 3))
    units[range(len(names)), range(len(names)), 2] = 1.0  # eigenvectors come with their eigenvalues ascending

    def mapped(errors: FloatArray) -> PlaneSlam:
        moved = np.tensordot(errors - 0.9, units, axes=1)
        return run_of(seen_falsely(scene.keyframes, names, np.outer(share, share), moved))

    key, none, steps = pose_symbol(14), np.zeros(len(names)), step * np.eye(len(names))
    slam, ahead, back = mapped(none), [mapped(one) for one in steps], [mapped(-one) for one in steps]
    now, there = slam.backend.chi2(), [one.backend.chi2() for one in ahead]
    vector = np.array([a - b.backend.chi2() for a, b in zip(there, back, strict=True)]) / (4.0 * step)
    both = [[mapped(one + other).backend.chi2() for one in steps] for other in steps]
    information = (np.array(both) - np.add.outer(there, there) + now) / (2.0 * step**2)
    poses = [[gtsam.Pose3(one.backend.pose(key)) for one in side] for side in (ahead, back)]
    effect = np.stack([b.localCoordinates(a) for a, b in zip(*poses, strict=True)], axis=1) / (2.0 * step)
    left = np.linalg.inv(np.eye(len(names)) + information)
    wanted = effect @ (left + np.outer(left @ vector, left @ vector)) @ effect.T
    added = slam.marginal_covariance(key) - slam.backend.covariance(key)
    np.testing.assert_allclose(added, wanted, atol=0.05 * np.abs(wanted).max())


def nees_of(plane: Plane) -> float:
    return plane.mahalanobis(max(room_planes(), key=lambda true: float(true.normal @ plane.normal)))


def test_what_has_no_errors_of_calibration_is_as_it_was() -> None:
    scene = drive(0)
    slam, blank = run_of(scene.keyframes), np.zeros((3, 3))
    given = [
        PlaneObservation(one.plane, calibration_effect=blank, sensor="c") for one in scene.keyframes[0].observations
    ]
    other = run_of([replace(scene.keyframes[0], observations=given), *scene.keyframes[1:]])
    key = pose_symbol(14)
    np.testing.assert_array_equal(slam.trajectory.poses, other.trajectory.poses)
    np.testing.assert_allclose(slam.marginal_covariance(key), other.marginal_covariance(key), rtol=1e-6, atol=1e-12)


def test_sensors_of_any_name_and_number_of_errors_are_told_apart() -> None:
    """One without a name, one that states more errors at times, one that states none: as by one error of each."""
    scene = drive(2)
    one, more = np.array([[1e-3], [0.0], [0.0]]), np.array([[1e-3, 0.0], [0.0, 0.0], [0.0, 0.0]])

    def covariance(by_second: FloatArray, name: str) -> FloatArray:
        stated = ((one, name), (by_second, "b"), (one, "b"), (None, "c"), (one, name), (None, ""))
        frames = []
        for frame in scene.keyframes:
            planes = [seen.plane for seen in frame.observations if isinstance(seen, PlaneObservation)]
            pairs = zip(planes, stated, strict=True)
            seen = [
                PlaneObservation(plane, calibration_effect=effect, sensor=sensor) for plane, (effect, sensor) in pairs
            ]
            frames.append(replace(frame, observations=seen))
        return run_of(frames).marginal_covariance(pose_symbol(14))

    np.testing.assert_allclose(covariance(more, ""), covariance(one, "a"), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("effect", [np.zeros((2, 3)), np.zeros(3), np.zeros((3, 0)), np.full((3, 1), np.nan)])
def test_an_effect_is_finite_and_of_three_rows(effect: FloatArray) -> None:
    with pytest.raises(ValueError, match=r"^calibration_effect: expected finite numbers of shape \(3, K\)"):
        PlaneObservation(room_planes()[0], calibration_effect=effect)


@pytest.mark.parametrize("left", [[[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[1, 1, 0], [0, 1, 0], [0, 0, 1]]])
def test_what_is_left_open_is_a_covariance(left: list[list[float]]) -> None:
    with pytest.raises(ValidationError, match="expected a covariance as left_open"):
        RangeWarp(shares=((0.0,),), shares_per_m=((0.0,),), left_open=left)
