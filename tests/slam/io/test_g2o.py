"""g2o files: GTSAM graphs with planes out and in, held against g2o's own definitions of its errors."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import factors
from slam.errors import LogError
from slam.geometry.frames import poses_of
from slam.io.g2o.reader import read_g2o
from slam.io.g2o.writer import _numbers, in_another_world, write_g2o
from spplanes import Location, Plane, ScanLine
from spplanes.spmodel import transform_from_rpy
from tests.factors.association_scenes import drawn
from tests.factors.factor_scenes import make_line, random_covariance

X = [gtsam.symbol("x", i) for i in range(3)]
P = [gtsam.symbol("p", i) for i in range(4)]
POSES = [
    transform_from_rpy(row) for row in ((0, 0, 0, 0, 0, 0), (0.5, 0.1, 0, 0.3, -0.01, 0.02), (1, 0, 0.1, 0, 0, -1))
]
MOUNT = transform_from_rpy((0.2, 0.0, 0.4, 0.0, 0.1, 0.5))


# g2o's definitions are from its plane3d.h, edge_se3_plane_calib.h, edge_se3.cpp, isometry3d_mappings.cpp.


def g2o_plane_error(seen: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """`seen.ominus(measured)`: (azimuth, elevation) of the measured normal in the seen one's axes, and d - d."""

    def angles(v):
        return np.arctan2(v[1], v[0]), np.arctan2(v[2], np.hypot(v[0], v[1]))

    azimuth, elevation = angles(seen[:3])
    axes = Rotation.from_euler("z", azimuth) * Rotation.from_euler("y", -elevation)
    return np.array([*angles(axes.inv().apply(measured[:3])), -seen[3] + measured[3]])


def g2o_move_plane(b_T_a: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """`Isometry3 * Plane3D`."""
    normal = b_T_a[:3, :3] @ plane[:3]
    return np.array([*normal, plane[3] - b_T_a[:3, 3] @ normal])


def g2o_pose_error(delta: np.ndarray) -> np.ndarray:
    """`toVectorMQT`: translation, imaginary part of the quaternion with w >= 0."""
    quaternion = Rotation.from_matrix(delta[:3, :3]).as_quat(canonical=True)
    return np.array([*delta[:3, 3], *quaternion[:3]])


def g2o_chi2(path: Path) -> dict[str, float]:
    """Half the sum of e^T W e of a file by g2o's definitions, by type of edge."""
    poses, planes, result = {}, {}, {}
    for line in path.read_text().splitlines():
        kind, *words = line.split()
        numbers = np.array(words, dtype=float) if not kind.startswith("#") else np.empty(0)
        if kind == "VERTEX_SE3:QUAT":
            poses[words[0]] = poses_of(numbers[None, 1:])[0]
        elif kind == "VERTEX_PLANE":
            planes[words[0]] = numbers[1:5]
        elif kind.startswith("EDGE"):
            if kind == "EDGE_SE3_PLANE_CALIB":
                sensor = poses[words[0]] @ poses[words[2]]
                measured = numbers[3:7] / np.linalg.norm(numbers[3:6])  # `Plane3D(Vector4)` normalises
                error = g2o_plane_error(g2o_move_plane(np.linalg.inv(sensor), planes[words[1]]), measured)
            else:
                start = np.eye(4) if kind == "EDGE_SE3_PRIOR" else poses[words[0]]
                end = poses[words[0]] if kind == "EDGE_SE3_PRIOR" else poses[words[1]]
                error = g2o_pose_error(np.linalg.inv(poses_of(numbers[None, 2:9])[0]) @ np.linalg.inv(start) @ end)
            matrix = np.zeros((len(error), len(error)))
            matrix[np.triu_indices(len(error))] = numbers[-len(error) * (len(error) + 1) // 2 :]
            matrix += np.triu(matrix, 1).T
            result[kind] = result.get(kind, 0.0) + 0.5 * error @ matrix @ error
    return result


def seen_plane(world: Plane, pose: np.ndarray, rng: np.random.Generator) -> Plane:
    """A plane as the pose sees it, off by about its own covariance, with strong cross terms."""
    return drawn(world.transform(np.linalg.inv(pose)), random_covariance(rng, np.array((0.01, 0.004, 0.02))), rng)


WALLS = [
    Plane.from_hesse(normal, d, np.diag([1e-6] * 3), centre=centre)
    for normal, d, centre in (
        ([0.0, 0.0, 1.0], 0.0, [1.0, 0.5, 0.0]),  # a floor: the pole of azimuth and elevation
        ([0.0, 0.0, -1.0], -2.5, [1.0, 0.5, 2.5]),
        ([-1.0, 0.0, 0.0], -4.0, [4.0, 0.3, 1.0]),
        ([0.0, 0.6, 0.8], -1.0, [0.0, -3.0, 1.0]),
    )
]


def plane_graph(seed: int = 0, robust=None) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Three poses, odometry, four planes anchored at the pose before their observer, seen from all poses."""
    rng = np.random.default_rng(seed)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(factors.pose_prior(X[0], POSES[0], random_covariance(rng, np.full(6, 1e-3))))
    for i in range(2):
        step = np.linalg.inv(POSES[i]) @ POSES[i + 1]
        noise = random_covariance(rng, np.full(6, 0.03))
        off = Location.pose(step, noise).perturbed(np.linalg.cholesky(noise) @ rng.standard_normal(6)).transform
        graph.push_back(factors.relative_pose_factor(X[i], X[i + 1], off, noise))
    for i, pose in enumerate(POSES):
        values.insert(X[i], gtsam.Pose3(pose))
    for j, wall in enumerate(WALLS):
        anchor = j % 3
        values.insert(P[j], factors.plane_landmark(wall.transform(np.linalg.inv(POSES[anchor]))))
        for i, pose in enumerate(POSES):
            factor = factors.plane_factor(seen_plane(wall, pose, rng), X[i], P[j], anchor_key=X[anchor], robust=robust)
            graph.push_back(factor)
    return graph, optimum(graph, values)


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-13)
    parameters.setAbsoluteErrorTol(1e-13)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def laser_line() -> ScanLine:
    """The line in which the scan plane of a laser on the second pose cuts the wall at x = 4, nearly."""
    local = WALLS[2].transform(np.linalg.inv(POSES[1] @ MOUNT))
    flat = np.linalg.norm(local.normal[:2])
    alpha, rho = float(np.arctan2(-local.normal[1], -local.normal[0])), float(-local.d / flat)
    return make_line(alpha + 0.002, rho + 0.003, np.array([[4e-6, 3e-6], [3e-6, 9e-6]]))


def written_and_read(path: Path, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, rel: float = 1e-9):
    """What a file of a graph is said to hold, and what is read of it: the same error at the same place."""
    content, back = write_g2o(path, graph, values), read_g2o(path)
    assert back.graph.error(back.values) == pytest.approx(graph.error(values), rel=rel)
    return content, back


def furthest_pose(content, back, values: gtsam.Values) -> float:
    """How far the optimum of what was read is from these values, over all poses."""
    solved = optimum(back.graph, back.values)
    return max(
        np.abs(values.atPose3(key).localCoordinates(solved.atPose3(back.poses[number]))).max()
        for key, number in content.poses.items()
    )


def held_at(key: int, height_m: float) -> gtsam.PoseTranslationPrior3D:
    """A pose held at a height."""
    floor = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e8, 1e8, 0.01]))
    return gtsam.PoseTranslationPrior3D(key, np.array([0.0, 0.0, height_m]), floor)


@pytest.mark.parametrize("seed", range(3))
def test_planes_and_odometry_come_back_as_they_were(tmp_path: Path, seed: int):
    graph, values = plane_graph(seed)
    content, back = written_and_read(tmp_path / "graph.g2o", graph, values)
    assert content.left_out == {}
    elsewhere, there = gtsam.Values(values), gtsam.Values(back.values)
    step = np.array([0.01, -0.02, 0.015, 0.03, 0.02, -0.01])
    for key, number in content.poses.items():  # the same function of the poses, not only the same value at one place
        elsewhere.update(key, values.atPose3(key).retract(step))
        there.update(back.poses[number], values.atPose3(key).retract(step))
    for key, number in content.planes.items():
        anchor = elsewhere.atPose3(X[(key - P[0]) % 3])
        there.update(back.planes[number], values.atOrientedPlane3(key).transform(anchor.inverse()))
    assert back.graph.error(there) == pytest.approx(graph.error(elsewhere), rel=1e-9)


def test_by_the_definitions_of_g2o_the_error_is_the_same(tmp_path: Path):
    graph, values = plane_graph()
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph, values)
    by_g2o = g2o_chi2(path)
    planes = [graph.at(i) for i in range(graph.size()) if i > 2]
    odometry = [graph.at(i) for i in (1, 2)]
    # beyond the first order the two ways to write an error differ: tilts here are of 0.01, turns of 0.03
    assert by_g2o["EDGE_SE3_PLANE_CALIB"] == pytest.approx(sum(f.error(values) for f in planes), rel=2e-3)
    assert by_g2o["EDGE_SE3:QUAT"] == pytest.approx(sum(f.error(values) for f in odometry), rel=0.05)


def test_a_line_is_an_edge_of_rank_two_with_its_error_and_optimum(tmp_path: Path):
    graph, values = plane_graph()
    line = laser_line()
    expected = values.atOrientedPlane3(P[2]).transform(values.atPose3(X[2]).between(values.atPose3(X[1])))
    graph.push_back(factors.line_factor(line, MOUNT, X[1], P[2], anchor_key=X[2], expected=expected))
    graph.push_back(factors.line_factor(line, MOUNT, X[1], P[2], anchor_key=X[2]))  # the custom form, as well
    values = optimum(graph, values)
    content, back = written_and_read(tmp_path / "graph.g2o", graph, values, 1e-8)
    information = np.zeros((3, 3))
    last = (tmp_path / "graph.g2o").read_text().splitlines()[-1].split()
    information[np.triu_indices(3)] = np.array(last[-6:], dtype=float)
    eigenvalues = np.linalg.eigvalsh(information + np.triu(information, 1).T)
    assert abs(eigenvalues[0]) < 1e-9 * eigenvalues[1]
    assert furthest_pose(content, back, values) < 1e-7


def test_priors_of_all_kinds_become_edges(tmp_path: Path):
    graph, values = plane_graph()
    graph.push_back(factors.plane_prior(seen_plane(WALLS[3], POSES[0], np.random.default_rng(1)), P[3]))
    for i, down in enumerate((1.0, -1.0)):
        graph.push_back(factors.direction_prior(P[i], [0.0, 0.0, down], 0.01, anchor_key=X[i]))
    graph.push_back(held_at(X[1], 0.02))
    level = gtsam.noiseModel.Isotropic.Sigma(2, 0.01)
    graph.push_back(gtsam.AttitudeFactorPose3(X[1], gtsam.Unit3(0.0, 0.0, 1.0), level))
    values = optimum(graph, values)
    content, back = written_and_read(tmp_path / "graph.g2o", graph, values, 1e-5)
    assert content.left_out == {}
    assert furthest_pose(content, back, values) < 1e-4  # the second order, of a tilt of 0.01


def test_a_graph_in_another_world_errs_as_it_did_and_is_solved_as_it_was(tmp_path: Path):
    """Priors on poses and on planes too, of which those on planes are held in the world itself."""
    graph, values = plane_graph()
    graph.push_back(factors.plane_prior(seen_plane(WALLS[3], POSES[0], np.random.default_rng(1)), P[3]))
    graph.push_back(held_at(X[1], 0.02))
    content = write_g2o(tmp_path / "graph.g2o", graph, values)
    here = read_g2o(tmp_path / "graph.g2o")
    motion = transform_from_rpy((3.0, -2.0, 0.5, 0.4, 0.2, -0.3))
    (tmp_path / "moved.g2o").write_text(in_another_world(tmp_path / "graph.g2o", here, motion))
    there = read_g2o(tmp_path / "moved.g2o")
    assert there.graph.error(there.values) == pytest.approx(here.graph.error(here.values), rel=1e-9)
    first, second = (optimum(one.graph, one.values) for one in (here, there))
    for number in content.poses.values():
        pose = gtsam.Pose3(motion).compose(first.atPose3(here.poses[number]))
        assert np.abs(pose.localCoordinates(second.atPose3(there.poses[number]))).max() < 1e-6
    for number in content.planes.values():
        plane = first.atOrientedPlane3(here.planes[number]).transform(gtsam.Pose3(motion).inverse())
        assert np.abs(plane.errorVector(second.atOrientedPlane3(there.planes[number]))).max() < 1e-6
    covariances = [
        gtsam.Marginals(one.graph, solved).marginalCovariance(one.poses[content.poses[X[2]]])
        for one, solved in ((here, first), (there, second))
    ]
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-4, atol=1e-9)


def test_landmarks_in_the_world_stay_where_they_are(tmp_path: Path):
    rng = np.random.default_rng(0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(factors.pose_prior(X[0], POSES[1], np.eye(6) * 1e-6))
    values.insert(X[0], gtsam.Pose3(POSES[1]))
    for key, wall in zip(P, WALLS, strict=True):
        graph.push_back(factors.plane_factor(seen_plane(wall, POSES[1], rng), X[0], key))
        values.insert(key, factors.plane_landmark(wall))
    _, back = written_and_read(tmp_path / "graph.g2o", graph, values)
    for key, wall in zip(back.planes.values(), WALLS, strict=True):
        found, wanted = back.values.atOrientedPlane3(key), factors.plane_landmark(wall)
        np.testing.assert_allclose(found.planeCoefficients(), wanted.planeCoefficients(), atol=1e-12)


def test_what_g2o_has_no_word_for_is_counted_and_said(tmp_path: Path):
    graph, values = plane_graph(robust="huber")
    graph.push_back(factors.parallel_factor(P[0], P[1], 0.01, anchor_a=X[0], anchor_b=X[1]))
    content = write_g2o(tmp_path / "graph.g2o", graph, values)
    assert content.left_out == {"robust kernels": 12, "CustomFactor": 1}
    assert "# left out: 12 of robust kernels" in (tmp_path / "graph.g2o").read_text()
    read_g2o(tmp_path / "graph.g2o")


def test_a_velocity_that_is_kept_is_written_as_the_motion_that_it_leads_to(tmp_path: Path):
    """Of the last two of its three poses: g2o has no edge of three."""
    graph, values = plane_graph()
    covariance = np.diag([1, 4, 9, 16, 25, 36]) * 1e-4
    graph.push_back(factors.constant_velocity_factor(X[:3], covariance, kept=0.5))
    content = write_g2o(tmp_path / "graph.g2o", graph, values)
    assert content.left_out == {}
    back = read_g2o(tmp_path / "graph.g2o").graph
    moved = values.atPose3(X[0]).between(values.atPose3(X[1]))
    there = gtsam.Pose3.Expmap(0.5 * gtsam.Pose3.Logmap(moved))
    written = back.at(back.size() - 1)
    assert there.equals(written.measured(), 1e-9)
    whole = factors.relative_pose_factor(*X[1:3], there, covariance)
    np.testing.assert_allclose(written.noiseModel().information(), whole.noiseModel().information(), rtol=1e-9)


def test_two_anchors_for_one_landmark_and_missing_values_are_refused(tmp_path: Path):
    graph, values = plane_graph()
    again = seen_plane(WALLS[0], POSES[1], np.random.default_rng(0))
    graph.push_back(factors.plane_factor(again, X[1], P[0], anchor_key=X[2]))
    with pytest.raises(ValueError, match="graph: expected one anchor for each landmark, got two for p0"):
        write_g2o(tmp_path / "graph.g2o", graph, values)
    values.erase(P[1])
    with pytest.raises(ValueError, match="values: expected one for every variable, got none for p1"):
        write_g2o(tmp_path / "graph.g2o", graph, values)


def test_gtsam_reads_the_poses_and_odometry(tmp_path: Path):
    graph, values = plane_graph()
    write_g2o(tmp_path / "graph.g2o", graph, values)
    theirs, poses = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert theirs.size() == 2
    for i in range(3):
        assert poses.atPose3(i).equals(values.atPose3(X[i]), 1e-9)


def test_a_file_that_gtsam_writes_is_read(tmp_path: Path):
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in enumerate(POSES):
        values.insert(i, gtsam.Pose3(pose))
    motion = gtsam.Pose3(POSES[0]).between(gtsam.Pose3(POSES[1]))
    graph.add(gtsam.BetweenFactorPose3(0, 1, motion, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    gtsam.writeG2o(graph, values, str(tmp_path / "theirs.g2o"))
    back = read_g2o(tmp_path / "theirs.g2o")
    assert back.graph.size() == 1 and len(back.poses) == 3
    for i in range(3):
        assert back.values.atPose3(back.poses[i]).equals(values.atPose3(i), 1e-6)


def test_a_sensor_beside_the_body_is_taken_into_account(tmp_path: Path):
    """One edge through a shifted and turned sensor, against g2o's definition, away from zero error."""
    sensor = transform_from_rpy((0.3, -0.2, 0.5, 0.4, -0.3, 0.9))
    seen = g2o_move_plane(np.linalg.inv(POSES[1] @ sensor), np.array([-1.0, 0.0, 0.0, 4.0]))
    measured = seen + np.array([0.0002, -0.0003, 0.0001, 0.002])
    root = np.array([[300.0, 50.0, -20.0], [0.0, 200.0, 30.0], [0.0, 0.0, 100.0]])
    upper = (root.T @ root)[np.triu_indices(3)]
    body, beside = (_numbers([*t[:3, 3], *Rotation.from_matrix(t[:3, :3]).as_quat()]) for t in (POSES[1], sensor))
    path = tmp_path / "one.g2o"
    path.write_text(
        f"VERTEX_SE3:QUAT 4 {body}\nVERTEX_SE3:QUAT 9 {beside}\nFIX 9 4\nVERTEX_PLANE 5 -1 0 0 4 0 0 0\n"
        f"EDGE_SE3_PLANE_CALIB 4 5 9 {_numbers(measured)} 0 0 0 {_numbers(upper)}\n"
    )
    back = read_g2o(path)
    assert back.graph.error(back.values) == pytest.approx(sum(g2o_chi2(path).values()), rel=2e-3)
    assert set(back.poses) == {4}  # the sensor is a constant, no variable


#: No motion, and no information on it.
AT_HOME = " 0" * 6 + " 1" + " 0" * 21
GOOD = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\nFIX 1\nVERTEX_PLANE 2 1 0 0 -3 0 0 0\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", r"expected at least one VERTEX_SE3:QUAT, got none"),
        ("VERTEX_XY 0 1 2\n", r":1: expected one of VERTEX_SE3:QUAT.*got 'VERTEX_XY'"),
        (GOOD + "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", r":5: expected each id once, got 0 again"),
        (GOOD + "VERTEX_PLANE 1 1 0 0 -3 0 0 0\n", r":5: expected each id once, got 1 again"),
        (GOOD + "VERTEX_SE3:QUAT 7 0 0 0 0 0 0\n", r":5: expected 8 numbers after VERTEX_SE3:QUAT, got 7"),
        (GOOD + "VERTEX_SE3:QUAT 7 0 0 x 0 0 0 1\n", r":5: expected numbers"),
        (GOOD + "VERTEX_SE3:QUAT -7 0 0 0 0 0 0 1\n", r":5: expected an id, a whole number, got '-7'"),
        (GOOD + "VERTEX_SE3:QUAT 7 0 0 0 0 0 0 2\n", r":5: expected a unit quaternion, got one of norm 2"),
        (GOOD + "VERTEX_PLANE 7 0 0 0 -3 0 0 0\n", r":5: expected the normal of a plane, got zero"),
        (GOOD + "FIX 12\n", r":5: expected a pose to fix, got the id 12"),
        (GOOD + "EDGE_SE3_PLANE_CALIB 0 3 1 1 0 0 -3 0 0 0 1 0 0 1 0 1\n", r":5: expected the id of a plane, got 3"),
        (GOOD + "EDGE_SE3_PLANE_CALIB 0 2 0 1 0 0 -3 0 0 0 1 0 0 1 0 1\n", r":5: expected a fixed sensor"),
        (GOOD + "EDGE_SE3_PLANE_CALIB 0 2 1 1 0 0 -3 0 0 0 1 2 0 1 0 1\n", r":5: expected a positive semidefinite"),
        (GOOD + f"EDGE_SE3:QUAT 0 8{AT_HOME}\n", r":5: expected the id of a pose, got 8"),
        (GOOD + f"EDGE_SE3_PRIOR 0 0{AT_HOME}\n", r":5: expected the id of a PARAMS_SE3OFFSET"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path: Path, text: str, sentence: str):
    path = tmp_path / "bad ö.g2o"
    path.write_text(text)
    with pytest.raises(LogError, match=sentence):
        read_g2o(path)


def test_the_sighting_of_a_kernel_is_that_of_the_bare_factor(tmp_path: Path):
    """A robust kernel's weight must not leak into the information."""
    robust, values = plane_graph(robust=("cauchy", 0.5))
    bare, _ = plane_graph()
    lines = []
    for graph in (robust, bare):
        write_g2o(tmp_path / "graph.g2o", graph, values)
        text = (tmp_path / "graph.g2o").read_text()
        lines.append([line.split()[1:] for line in text.splitlines() if line.startswith("EDGE_SE3_PLANE")])
    np.testing.assert_allclose(np.array(lines[0], dtype=float), np.array(lines[1], dtype=float), rtol=1e-8, atol=1e-8)
