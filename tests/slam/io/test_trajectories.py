"""Trajectory and relations files: strict readers, exact writers."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.errors import LogError
from slam.evaluation.trajectories import read_relations
from slam.io.trajectories import Trajectory, read_kitti, read_tum, write_kitti, write_tum


def poses_at(places, turns):
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), places
    return poses


def some_poses(n):
    rng = np.random.default_rng(0)
    return poses_at(1e3 * rng.standard_normal((n, 3)), Rotation.random(n, rng=rng))


def test_tum_round_trip(tmp_path):
    stamps = np.array([-1, 0, 1, 976_052_890_244_111_000, 2**62], dtype=np.int64)
    trajectory = Trajectory(stamps, some_poses(5))
    write_tum(tmp_path / "t.tum", trajectory)
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps)
    np.testing.assert_array_equal(back.poses[:, :3, 3], trajectory.poses[:, :3, 3])
    np.testing.assert_allclose(back.poses, trajectory.poses, atol=1e-15)
    assert len(back) == 5


def test_tum_says_what_everybody_means(tmp_path):
    (tmp_path / "t.tum").write_text("# t x y z qx qy qz qw\n1.5 1 2 3 0 0 0.7071068 0.7071068\n\n2.5 0 0 0 0 0 0 -1\n")
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(back.poses[0] @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-9)
    np.testing.assert_allclose(back.poses[1], np.eye(4))
    write_tum(tmp_path / "out.tum", Trajectory(np.array([1_500_000_000]), np.eye(4)[None]))
    assert (tmp_path / "out.tum").read_text().splitlines()[1] == "1.500000000 0.0 0.0 0.0 0.0 0.0 0.0 1.0"


def test_kitti_round_trip_and_order(tmp_path):
    poses = some_poses(4)
    write_kitti(tmp_path / "k.txt", poses)
    np.testing.assert_array_equal(read_kitti(tmp_path / "k.txt"), poses)
    first = [float(word) for word in (tmp_path / "k.txt").read_text().split()[:12]]
    np.testing.assert_array_equal(np.reshape(first, (3, 4)), poses[0, :3])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", r"t\.tum: expected at least one line"),
        ("# only\n", r"t\.tum: expected at least one line"),
        ("1 0 0 0 0 0 0\n", r"t\.tum:1: expected 8 numbers, got 7 words"),
        ("1 0 0 0 0 0 0 1\n2 0 0 zero 0 0 0 1\n", r"t\.tum:2: expected numbers"),
        ("1 0 0 nan 0 0 0 1\n", r"t\.tum:1: expected finite numbers"),
        ("nan 0 0 0 0 0 0 1\n", r"t\.tum:1: expected numbers \(expected a time"),
        ("1 0 0 0 0 0 0 1\n# c\n1 0 0 0 0 0 0 1\n", r"t\.tum:3: expected times that ascend"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r"t\.tum:2: expected times that ascend"),
        ("1 0 0 0 0 0 0 0\n", r"t\.tum:1: expected a unit quaternion, got one of norm 0"),
        ("1 0 0 0 1 1 0 0\n", r"t\.tum:1: expected a unit quaternion, got one of norm 1\.41"),
        ("1 " * 60_000, r"t\.tum:1: expected lines shorter"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", r"k\.txt:1: expected 12 numbers, got 11"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", r"k\.txt:1: expected a right-handed rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r"k\.txt:1: expected a right-handed rotation"),
    ],
)
def test_bad_tum_and_kitti_files(tmp_path, text, sentence):
    name, read = ("k.txt", read_kitti) if sentence.startswith("k") else ("t.tum", read_tum)
    (tmp_path / name).write_text(text)
    with pytest.raises(LogError, match=sentence):
        read(tmp_path / name)


def test_missing_and_cut_files(tmp_path):
    with pytest.raises(LogError, match=r"none\.tum: cannot be read"):
        read_tum(tmp_path / "none.tum")
    data = gzip.compress(b"".join(b"1 2 %f 0 0 0 0 0\n" % x for x in np.random.default_rng(0).uniform(size=5000)))
    (tmp_path / "cut.gz").write_bytes(data[: len(data) // 2])
    with pytest.raises(LogError, match=r"cut\.gz:\d+: the gzip stream breaks off here"):
        read_relations(tmp_path / "cut.gz")


def test_trajectories_refuse_what_is_none():
    with pytest.raises(ValueError, match="stamps_ns: expected strictly ascending"):
        Trajectory(np.array([1, 1]), some_poses(2))
    with pytest.raises(ValueError, match="stamps_ns: expected integers"):
        Trajectory(np.array([1.0, 2.0]), some_poses(2))
    with pytest.raises(ValueError, match="poses: expected shape"):
        Trajectory(np.array([1, 2]), some_poses(3))


def test_relations_frames(tmp_path):
    (tmp_path / "r").write_text("1.0 2.0 1 2 3 0.1 0.2 0.3\n")
    relations = read_relations(tmp_path / "r")
    expected = Rotation.from_euler("ZYX", [0.3, 0.2, 0.1]).as_matrix()  # Rz(yaw) Ry(pitch) Rx(roll)
    np.testing.assert_allclose(relations.a_T_b[0, :3, :3], expected, atol=1e-15)
    np.testing.assert_array_equal(relations.a_T_b[0, :3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(relations.stamps_ns, [[10**9, 2 * 10**9]])


#: Written by evo 1.38.1: x = 0.5 k, y = -0.25 k, z = 0.125 k^2; turns of 0.3 k, -0.1 k and 0.05 k about z, y and x.
EVO = Path(__file__).parent / "fixtures"


def evo_poses():
    k = np.arange(4.0)
    turns = Rotation.from_euler("zyx", np.column_stack((0.3 * k, -0.1 * k, 0.05 * k)))
    return poses_at(np.column_stack((0.5 * k, -0.25 * k, 0.125 * k**2)), turns)


def test_what_evo_writes():
    trajectory = read_tum(EVO / "evo.tum")
    np.testing.assert_allclose(trajectory.poses, evo_poses(), atol=1e-12)
    seconds = np.array([1305031102.175304, 1305031102.211214, 1305031102.75, 1305031103.0])
    np.testing.assert_allclose(trajectory.stamps_ns / 1e9, seconds, rtol=0.0, atol=3e-7)
    np.testing.assert_allclose(read_kitti(EVO / "evo_kitti.txt"), evo_poses(), atol=1e-12)


def test_poses_between_those_of_a_trajectory():
    trajectory = read_tum(EVO / "evo.tum")
    first, last = trajectory.stamps_ns[[2, 3]]
    middle = trajectory.poses_at([(first + last) // 2])[0]
    np.testing.assert_allclose(middle[:3, 3], evo_poses()[2:, :3, 3].mean(axis=0), atol=1e-8)
    turns = Rotation.from_matrix(evo_poses()[2:, :3, :3])
    half = turns[0] * Rotation.from_rotvec(0.5 * (turns[0].inv() * turns[1]).as_rotvec())
    np.testing.assert_allclose(middle[:3, :3], half.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(trajectory.poses_at([0, 2**62]), evo_poses()[[0, 3]], atol=1e-12)
