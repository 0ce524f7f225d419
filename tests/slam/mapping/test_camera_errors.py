"""What a camera's calibration leaves open: its effect on a plane, by points; and covariances that hold with it."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from factors.association.observations import PlaneObservation
from slam import Keyframe
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


def seen_falsely(keyframes: list[Keyframe], names: tuple[str, ...], share: float, errors: FloatArray) -> list[Keyframe]:
    """What cameras see whose ranges are too long by a share in any direction: every other plane by each of them."""
    warp, found = open_by(share**2 * np.eye(3)), []
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
        slam = run_of(seen_falsely(scene.keyframes, names, share, errors))
        key, estimate = pose_symbol(14), slam.trajectory.poses[14]
        poses.append(planar_nees(slam.marginal_covariance(key), scene.world_T_body[14], estimate))
        assert len(slam.planes) == 6
        without.append(planar_nees(slam.backend.covariance(key), scene.world_T_body[14], estimate))
        planes.append(np.mean([nees_of(one.plane) for one in slam.planes]))
    assert_mean_in_band(np.array(poses), 3)
    assert 2.0 < np.mean(planes) < 4.0  # six planes of one error are no six draws
    assert np.mean(without) > 3.0 * times


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


@pytest.mark.parametrize("effect", [np.zeros((2, 3)), np.zeros(3), np.full((3, 1), np.nan)])
def test_an_effect_is_finite_and_of_three_rows(effect: FloatArray) -> None:
    with pytest.raises(ValueError, match=r"^calibration_effect: expected finite numbers of shape \(3, K\)"):
        PlaneObservation(room_planes()[0], calibration_effect=effect)


@pytest.mark.parametrize("left", [[[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[1, 1, 0], [0, 1, 0], [0, 0, 1]]])
def test_what_is_left_open_is_a_covariance(left: list[list[float]]) -> None:
    with pytest.raises(ValidationError, match="expected a covariance as left_open"):
        RangeWarp(shares=((0.0,),), shares_per_m=((0.0,),), left_open=left)
