"""Evaluation: errors put in come out, and known scores of real data are reproduced."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapely import Polygon, box

from slam.evaluation import (
    absolute_error,
    align,
    match_planes,
    nearest_stamps,
    plane_metrics,
    relation_errors,
    relation_metrics,
    relative_error,
)
from slam.evaluation.trajectories import Relations, read_relations
from slam.geometry.frames import planar_transform
from slam.io.carmen import read_carmen
from slam.io.trajectories import Trajectory, read_tum
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.slam.real_data import needs


def helix(n=60):
    places = [(4.0 * np.sin(a), -4.0 * np.cos(a), 0.3 * a, a, 0.0, 0.0) for a in np.linspace(0.0, 5.0, n)]
    return Trajectory(np.arange(n) * 10**8, np.array([transform_from_rpy(place) for place in places]))


def moved(trajectory, transform):
    return Trajectory(trajectory.stamps_ns, transform @ trajectory.poses)


SOME_TRANSFORM = transform_from_rpy((5.0, -6.0, 7.0, 2.0, 0.4, -0.3))


def values_of(rows):
    return {row.name: row.value for row in rows}


def test_alignment_takes_out_where_the_world_lies():
    truth = helix()
    errors = absolute_error(moved(truth, SOME_TRANSFORM), truth)
    assert errors.translation_m.max() < 1e-12 and errors.rotation_rad.max() < 1e-12
    first = absolute_error(moved(truth, SOME_TRANSFORM), truth, alignment="first")
    assert first.translation_m.max() < 1e-12
    raw = absolute_error(moved(truth, planar_transform(3.0, 4.0, 0.0)), truth, alignment="none")
    np.testing.assert_allclose(raw.translation_m, 5.0)
    flat = absolute_error(moved(truth, planar_transform(3.0, 4.0, 1.0)), truth, alignment="se2")
    assert flat.translation_m.max() < 1e-12
    tilted = absolute_error(moved(truth, SOME_TRANSFORM), truth, alignment="se2")
    assert tilted.translation_m.max() > 0.5
    with pytest.raises(ValueError, match="alignment: expected 'se3'"):
        absolute_error(truth, truth, alignment="sim3")  # type: ignore[arg-type]


def test_a_way_on_a_line_is_aligned_by_its_orientations_too():
    """Two centimetres across a way of 1 m turn it by a degree; about the way itself positions tell nothing at all."""
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, 1.0, 10)
    stamps = np.arange(10) * 10**9
    off = poses.copy()
    off[:, :3, 3] += rng.normal(0.0, 0.01, (10, 3))
    off[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 1e-3, (10, 3))).as_matrix()
    truth, estimate = Trajectory(stamps, poses), Trajectory(stamps, SOME_TRANSFORM @ off)
    by_positions = absolute_error(estimate, truth).rotation_rad
    by_poses = absolute_error(estimate, truth, alignment="poses")
    assert by_positions.max() > 0.01
    assert by_poses.rotation_rad.max() < 4e-3 and by_poses.translation_m.max() < 0.04
    exact = absolute_error(moved(truth, SOME_TRANSFORM), truth, alignment="poses")
    assert exact.rotation_rad.max() < 1e-6 and exact.translation_m.max() < 1e-9


def test_alignment_never_mirrors():
    source = np.random.default_rng(0).standard_normal((30, 3))
    mirrored = source * [1.0, 1.0, -1.0]
    assert np.linalg.det(align(source, mirrored)[:3, :3]) == pytest.approx(1.0)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 0.0])
    np.testing.assert_allclose(align(line, line + np.array([1, 0, 0])) @ [0, 0, 0, 1], [1, 0, 0, 1], atol=1e-9)


def test_statistics_of_absolute_errors():
    truth = helix(4)
    poses = truth.poses.copy()
    poses[:, 2, 3] += [0.0, 0.0, 0.1, 0.3]
    *rows, rotation = absolute_error(Trajectory(truth.stamps_ns, poses), truth, alignment="none").metrics("ATE")
    wanted = {"rmse": np.sqrt(0.025), "mean": 0.1, "median": 0.05, "max": 0.3}
    assert rows[:4] == [(f"ATE translation {name}", pytest.approx(value), "m") for name, value in wanted.items()]
    assert rotation == ("ATE rotation max", pytest.approx(0.0, abs=1e-12), "deg")


def test_turning_on_the_spot_is_no_error_of_position():
    truth = helix()
    turned = Trajectory(truth.stamps_ns, truth.poses @ planar_transform(0.0, 0.0, 0.1))
    errors = absolute_error(turned, truth, alignment="none")
    assert errors.translation_m.max() < 1e-12
    np.testing.assert_allclose(errors.rotation_rad, 0.1)


def test_relative_error_sees_drift_and_not_the_frame():
    truth = Trajectory(np.arange(101), np.array([planar_transform(0.1 * k, 0.0, 0.0) for k in range(101)]))
    stretched = Trajectory(truth.stamps_ns, np.array([planar_transform(0.11 * k, 0.0, 0.0) for k in range(101)]))
    errors = relative_error(moved(stretched, SOME_TRANSFORM), truth, way_m=0.95)
    assert errors.translation_m.size == 91
    np.testing.assert_allclose(errors.translation_m, 0.1, atol=1e-9)
    assert relative_error(truth, truth, way_m=1000.0).translation_m.size == 0
    assert np.isnan(relative_error(truth, truth, way_m=1000.0).metrics("RPE")[0].value)


def test_times_are_matched_to_the_nearest():
    stamps = np.array([0, 10, 20, 30])
    np.testing.assert_array_equal(nearest_stamps(np.array([-3, 4, 6, 14, 29, 99]), stamps, 5), [0, 0, 1, 1, 3, -1])
    np.testing.assert_array_equal(nearest_stamps(np.array([7]), np.array([5]), 5), [0])
    np.testing.assert_array_equal(nearest_stamps(np.array([7]), np.array([], dtype=np.int64), 5), [-1])
    with pytest.raises(ValueError, match="expected times in common"):
        absolute_error(helix(), Trajectory(helix().stamps_ns + 10**12, helix().poses))


def test_relations_score_what_was_done_to_them():
    truth = helix()
    pairs = np.array([[0, 10], [30, 5], [2, 50]])
    a_T_b = np.linalg.inv(truth.poses[pairs[:, 0]]) @ truth.poses[pairs[:, 1]]
    relations = Relations(truth.stamps_ns[pairs], a_T_b)
    assert relation_errors(truth, relations).translation_m.max() < 1e-12
    off = a_T_b @ planar_transform(0.3, 0.4, 0.1)
    errors = relation_errors(truth, Relations(truth.stamps_ns[pairs], off))
    np.testing.assert_allclose(errors.translation_m, 0.5)
    np.testing.assert_allclose(errors.rotation_rad, 0.1)
    strangers = Relations(truth.stamps_ns[pairs] + 1_000_000, off)  # exactly 1 ms off does not count
    with pytest.raises(ValueError, match="none that agree to 1 ms"):
        relation_metrics(truth, strangers)
    assert relation_errors(truth, Relations(truth.stamps_ns[pairs] + 999_999, off)).translation_m.size == 3


def test_known_scores_of_the_intel_log():
    """The figures that come with the data: 97 relations, mean 0.036 m / 0.56 deg; raw odometry 3.2 m / 17 deg."""
    relations = read_relations(needs("intel/intel.relations.gz"))
    reference = read_tum(needs("intel/reference.tum"))
    odometry = read_carmen(needs("intel/intel.clf.gz")).odometry
    raw = Trajectory(np.array([r.stamp_ns for r in odometry]), np.array([r.odom_T_body for r in odometry]))
    scores = [values_of(relation_metrics(trajectory, relations)) for trajectory in (reference, raw)]
    assert scores[0]["relations found"] == scores[1]["relations found"] == 97
    assert round(scores[0]["relations translation mean"], 3) == 0.036
    assert round(scores[0]["relations rotation mean"], 2) == 0.56
    assert round(scores[1]["relations translation mean"], 1) == 3.2
    assert int(scores[1]["relations rotation mean"]) == 17
    ate = values_of(absolute_error(raw, reference).metrics("ATE"))
    # What evo 1.x prints for the same two files: evo_ape tum -a, and with -r angle_deg
    assert ate["ATE translation rmse"] == pytest.approx(24.017560, abs=1e-6)
    assert ate["ATE translation median"] == pytest.approx(17.277707, abs=1e-6)
    assert ate["ATE rotation rmse"] == pytest.approx(102.940610, abs=1e-6)


def plane(normal, d, outline=None, sigma=0.01, centre=(0.0, 0.0, 0.0)):
    """A plane whose frame lies on the foot of `centre`; the outline is given in that frame's x and y."""
    made = Plane.from_hesse(np.array(normal, dtype=float), d, sigma**2 * np.eye(3), centre=centre)
    return Plane(made.frame, made.covariance, outline=outline)


def test_planes_are_matched_to_the_nearest_that_overlaps_on_the_same_side():
    patch = box(-1.0, -1.0, 1.0, 1.0)
    wall, locker = plane((0, 1, 0), 2.0, box(-5.0, -5.0, 5.0, 5.0)), plane((0, 1, 0), 1.95, patch)
    back, far = plane((0, -1, 0), -2.009, patch), plane((0, 1, 0), 2.0, patch, centre=(30.0, 0.0, 0.0))
    truth = [wall, locker, back, far]
    found = [plane((0, 1, 0), 1.957, patch), plane((0, 1, 0), 2.01, patch), plane((1, 0, 0), 0.0, patch)]
    matches = match_planes(found, truth)
    assert [(m.estimated, m.true) for m in matches] == [(0, 1), (1, 0)]
    assert matches[0].distance_m == pytest.approx(0.007) and matches[1].distance_m == pytest.approx(0.01)
    assert matches[1].nees == pytest.approx(0.01**2 / (2.0 * 0.01**2))  # the truth here has a covariance as well


def test_plane_metrics_count_duplicates_missed_and_invented():
    patch = box(-1.0, -1.0, 1.0, 1.0)
    truth = [plane((0, 0, 1), 0.0, patch), plane((0, 0, -1), -2.7, patch), plane((1, 0, 0), -3.0, patch)]
    tilted = np.array([np.sin(0.01), 0.0, np.cos(0.01)])
    found = [plane((0, 0, 1), 0.01, patch), plane(tilted, 0.0, patch), plane((0, 1, 0), 9.0, patch)]
    values = values_of(plane_metrics(found, truth))
    assert values["planes estimated"] == values["planes true"] == 3
    assert values["planes missed"] == pytest.approx(200.0 / 3.0)
    assert values["planes duplicate"] == pytest.approx(50.0)
    assert values["planes invented"] == pytest.approx(100.0 / 3.0)
    assert values["plane angle max"] == pytest.approx(np.rad2deg(0.01))
    assert values["plane distance max"] == pytest.approx(0.01)
    some = values_of(plane_metrics(found, truth, visible={0, 1}))
    assert some["planes true"] == 2 and some["planes missed"] == pytest.approx(50.0)
    empty = values_of(plane_metrics([], truth))
    assert empty["planes missed"] == 100.0 and np.isnan(empty["plane angle median"])


def test_outlines_are_compared_in_one_frame():
    """The same patch described in two frames of one plane overlaps with itself."""
    frame, corners = planar_transform(3.0, 1.0, np.deg2rad(40.0)), np.array([[0, 0], [4, 0], [4, 1], [0, 1]])
    inside = Polygon((corners - frame[:2, 3]) @ frame[:2, :2])
    a = Plane(np.eye(4), np.eye(3), outline=Polygon(corners))
    assert len(match_planes([Plane(frame, np.eye(3), outline=inside)], [a])) == 1
    shifted = planar_transform(4.0, 4.0, 0.0) @ frame
    assert match_planes([Plane(shifted, np.eye(3), outline=inside)], [a]) == []
