"""Drives carry the noise that their names say, and truth that is of their scans."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.drives import ODOMETRIES, Recipe, make_drive
from benchmarks.corpus.drives.sensing import depth_sigma
from benchmarks.corpus.drives.worlds import WORLDS
from benchmarks.corpus.handheld import make_handheld
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse, lift
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.sensors.wheel_noise import OdometryNoise
from tests.slam.beams import beam_errors
from tests.slam.scenes import assert_same_events
from tests.statistics import assert_mean_in_band, mean_nees_band


def assert_scatter(errors, sigma):
    assert_mean_in_band((errors / sigma) ** 2, 1, level=0.999)


@pytest.mark.parametrize(
    "name", ["irregular/level", "bare/pushbroom/good/fifth", "sloped/lidar16/good/fifth", "ramp/lidar16/good/fifth"]
)
def test_ranges_scatter_about_the_true_planes_as_the_rig_says(name):
    drive = make_drive(Recipe.parse(name), 3)
    for sensor, described in drive.rig.sensors.items():
        errors = beam_errors(drive, sensor).range_m
        assert errors.size > 10_000
        assert_scatter(errors, described.range_sigma_m)


def test_depths_scatter_more_the_farther_they_are():
    seen = beam_errors(make_drive(Recipe.parse("hall/depth/good/fifth"), 1), "camera")
    errors = seen.range_m * seen.rays[:, 2]
    depth = seen.points[:, 2] - errors
    far = depth < 4.8  # beyond, those read too far are lost
    assert_scatter(errors[far], depth_sigma(depth)[far])


@pytest.mark.parametrize(("kind", "factor"), [("good", 1.0), ("worse3", 9.0)])
def test_odometry_errs_as_much_as_its_kind_says(kind, factor):
    """NEES of the motion over a curved way, against the noise that the rig states."""
    poses = WORLDS["loop"](np.random.default_rng(0)).course.poses_at(np.linspace(4.0, 7.0, 30))
    true, values = planar_delta(inverse(poses[0]) @ poses[-1]), []
    for seed in range(400):
        read = ODOMETRIES[kind](poses, OdometryNoise(), np.random.default_rng(seed))
        total, covariance = OdometryNoise().accumulate([planar_delta(inverse(a) @ b) for a, b in pairwise(read)])
        values.append((total - true) @ np.linalg.solve(covariance, total - true))
    low, high = mean_nees_band(400, 3, level=0.999)
    assert low < np.mean(values) / factor < high * 1.05  # 9 times the variance turns far enough to leave first order


def test_there_is_no_odometry_or_one_that_stands():
    assert make_drive(Recipe.parse("bare/lidar16/absent/fifth"), 0).log.odometry == []
    still = make_drive(Recipe.parse("bare/level/still/fifth"), 0)
    assert all(np.array_equal(reading.odom_T_body, np.eye(4)) for reading in still.log.odometry)
    assert np.linalg.norm(still.truth.world_T_body[-1, :3, 3]) > 15.0
    stops = make_drive(Recipe.parse("bare/level/stops/fifth"), 0)
    poses = np.array([reading.odom_T_body for reading in stops.log.odometry])
    stands = np.all(np.isclose(poses[1:], poses[:-1], atol=1e-12), axis=(1, 2))
    assert np.mean(stands) == pytest.approx(0.2, abs=0.01) and not stands[0] and not stands[-1]
    way = stops.truth.poses_at(np.array([reading.stamp_ns for reading in stops.log.odometry]))[:, :3, 3]
    assert np.linalg.norm(np.diff(way, axis=0), axis=1)[stands].min() > 0.0


@pytest.mark.parametrize(("kind", "factor"), [("noise0.3", 0.3), ("noise3", 3.0)])
def test_the_rig_states_another_noise_than_the_ranges_have(kind, factor):
    drive = make_drive(Recipe.parse(f"bare/level/good/{kind}"), 0)
    assert_scatter(beam_errors(drive, "horizontal").range_m, drive.rig.sensors["horizontal"].range_sigma_m / factor)


def test_a_rig_with_its_laser_backwards_puts_the_points_behind():
    right, wrong = (make_drive(Recipe.parse(f"office/level/good/{kind}"), 0) for kind in ("none", "backwards"))
    mounts = [drive.rig.sensors["horizontal"].body_T_sensor for drive in (right, wrong)]
    assert np.array_equal(mounts[0][:3, 3], mounts[1][:3, 3]) and mounts[1][0, 0] == pytest.approx(-mounts[0][0, 0])
    assert mounts[1][2, 2] == pytest.approx(mounts[0][2, 2])
    assert np.array_equal(right.log.scans()[5].ranges, wrong.log.scans()[5].ranges, equal_nan=True)


@pytest.mark.parametrize("kind", ["half", "fifth", "reversed"])
def test_truth_and_labels_go_with_the_scans_that_are_left(kind):
    whole = make_drive(Recipe.parse("office/level"), 0)
    drive = make_drive(Recipe.parse(f"office/level/good/{kind}"), 0)
    assert_scatter(beam_errors(drive, "horizontal").range_m, 0.015)
    share = {"half": 2, "fifth": 5, "reversed": 1}[kind]
    assert len(drive.log.scans()) == -(-len(whole.log.scans()) // share)
    stamps = [event.stamp_ns for event in drive.log.events]
    assert stamps == sorted(stamps)
    if kind == "reversed":
        assert np.array_equal(drive.truth.world_T_body[0], whole.truth.world_T_body[-1])


def test_a_prior_map_errs_as_it_says_and_starts_where_its_kind_says():
    nees = []
    for seed in range(3):
        drive = make_drive(Recipe.parse("office/level/good/prior"), seed)
        true = [plane for plane in drive.truth.planes if plane.outline.area >= 0.5]
        nees += [one.plane.mahalanobis(t) for one, t in zip(drive.prior.planes, true, strict=True)]
        off = inverse(drive.truth.world_T_body[0]) @ drive.prior.world_T_start
        assert np.linalg.norm(off[:2, 3]) < 0.5
    assert_mean_in_band(nees, 3, level=0.999)
    wrong = make_drive(Recipe.parse("office/level/good/prior_start"), 0)
    off = inverse(wrong.truth.world_T_body[0]) @ wrong.prior.world_T_start
    assert np.linalg.norm(off[:2, 3]) == pytest.approx(2.0)
    elsewhere = make_drive(Recipe.parse("office/level/good/prior_elsewhere"), 0)
    assert len(elsewhere.prior.planes) != len(wrong.prior.planes)


def test_same_recipe_and_seed_same_bits_and_other_parts_leave_the_building_alone():
    first, again = (make_drive(Recipe.parse("glass/level/worse3/half"), 8) for _ in range(2))
    assert_same_events(first.log.events, again.log.events)
    other = make_drive(Recipe.parse("glass/pushbroom/good/fifth"), 8)
    assert all(np.array_equal(a.frame, b.frame) for a, b in zip(first.truth.planes, other.truth.planes, strict=True))
    planes = make_drive(Recipe.parse("glass/level/worse3/half"), 9).truth.planes
    assert len(planes) != len(first.truth.planes) or not np.array_equal(planes[1].frame, first.truth.planes[1].frame)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("castle/level", "world: expected one of irregular"),
        ("office/sonar", "sensors: expected one of level"),
        ("office/level/perfect", "odometry: expected one of good"),
        ("office/level/good/fire", "disturbance: expected one of none"),
        ("office", "name: expected world/sensors"),
    ],
)
def test_a_recipe_of_something_unknown_says_what_is_known(name, sentence):
    with pytest.raises(ValueError, match=sentence):
        Recipe.parse(name)


def test_visits_of_one_building_differ_in_their_noise_and_their_way():
    whole = make_drive(Recipe.parse("office/level"), 0)
    again = make_drive(Recipe.parse("office/level"), 0, visit=1)
    assert [one.d for one in again.truth.planes] == [one.d for one in whole.truth.planes]
    assert not np.array_equal(again.log.odometry[5].odom_T_body, whole.log.odometry[5].odom_T_body)
    part = make_drive(Recipe.parse("office/level"), 0, part=(0.25, 0.75), backwards=True)
    start, way = part.truth.world_T_body[0], whole.truth.world_T_body
    there = way[round(0.75 * (len(way) - 1))]
    np.testing.assert_allclose(start[:3, 3], there[:3, 3], atol=0.15)
    np.testing.assert_allclose(start[:2, 0], -there[:2, 0], atol=0.05)
    for wrong in ((0.5, 0.5), (-0.1, 0.5), (0.2, 1.1)):
        with pytest.raises(ValueError, match="expected shares of the way"):
            make_drive(Recipe.parse("office/level"), 0, part=wrong)
    with pytest.raises(ValueError, match="expected a level course"):
        make_drive(Recipe.parse("ramp/lidar16"), 0, part=(0.0, 0.5))


@pytest.fixture(scope="module", params=["handheld/far", "handheld/sparse_far", "handheld/desk"])
def drive(request):
    """One of each sort of room."""
    return make_handheld(request.param, 3)


def test_the_camera_moves_as_its_kind_says(drive) -> None:
    """Up to 0.5 m/s along x and y and 40 deg/s about z, over a desk along an arc; it gets near both in 12 s."""
    poses, seconds = drive.truth.world_T_body, np.diff(drive.truth.stamps_ns) * 1e-9
    steps = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(inverse(a) @ b)) for a, b in pairwise(poses)])
    rates, speeds = (np.linalg.norm(steps[:, part], axis=1) / seconds for part in (slice(3), slice(3, 6)))
    assert np.deg2rad(21.0) < rates.max() < np.deg2rad(80.0) and 0.24 < speeds.max() < 0.9


def test_points_lie_on_the_planes_they_are_labelled_with(drive) -> None:
    """Within what a Kinect's noise and, in sparse rooms, false depths make of them; half of all pixels see a plane."""
    off, ranges, truth = [], [], drive.truth
    images = list(zip(drive.log.scans(), truth.world_T_body, truth.labels["camera"], strict=True))
    for scan, pose, labels in images[::9]:
        on = labels >= 0
        planes = [truth.planes[label] for label in labels[on]]
        normals, d = np.array([plane.normal for plane in planes]), np.array([plane.d for plane in planes])
        off.append(np.abs(np.einsum("ki,ki->k", lift(scan.points[on], pose @ CAMERA_MOUNT), normals) - d))
        ranges.append(scan.points[on][:, 2])
        assert on.mean() > 0.3
    assert np.median(np.concatenate(off) / np.concatenate(ranges)) < (0.02 if drive.recipe.world == "hall" else 0.005)
