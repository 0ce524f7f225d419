"""A run's folder out to files of other tools, and each of them read back."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from slam.errors import LogError
from slam.evaluation import Metric
from slam.io.planes_json import write_planes
from slam.io.trajectories import read_kitti, write_tum
from slam.output.export import export_run
from slam.output.run_files import as_json, write_json, write_ply
from slam.runs.history import History
from slam.runs.stored_run import StoredRun
from slam.visualization.mesh import mesh_of, write_glb
from tests.slam.commands import command, refused
from tests.slam.ply_tables import read_tables
from tests.slam.visualization.test_open3d_export import WINDOW, moving, needs_open3d, o3d, two_planes, wall

GRAPH = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder with two planes, one of them in two patches, and three poses."""
    folder = tmp_path / "a run <&> ü"
    folder.mkdir()
    planes = two_planes()
    write_planes(folder / "planes.json", planes)
    write_ply(folder / "map.ply", mesh_of(planes))
    write_tum(folder / "trajectory.tum", moving(3))
    write_json(folder / "metrics.json", {"metrics": as_json([Metric("planes", 2, "")]), "notes": []})
    nis, covariances = {"plane": [(1, 2.5, 3), (2, 4.5, 3)]}, {0: np.eye(6) * 1e-6, 2: np.eye(6) * 1e-4}
    replace(History.of(planes), nis=nis, pose_covariances=covariances).write(folder / "view.json")
    (folder / "graph.g2o").write_text(GRAPH)
    return folder


def test_every_target_from_the_command_line(run: Path, tmp_path: Path):
    names = ("planes.ply", "planes.glb", "graph.g2o", "traj.tum", "traj.kitti", "TRAJ.KITTI.TXT")
    (out := tmp_path / "out").mkdir()
    assert command("export", run, *[word for name in names for word in ("--to", out / name)]) == 0
    for name, own in (("planes.ply", "map.ply"), ("graph.g2o", "graph.g2o"), ("traj.tum", "trajectory.tum")):
        assert (out / name).read_bytes() == (run / own).read_bytes()
    for name in names[-2:]:
        np.testing.assert_array_equal(read_kitti(out / name), moving(3).poses)
    assert sorted(file.name for file in out.iterdir()) == sorted(names)


def test_a_file_that_exists_is_kept_unless_told_otherwise(run: Path, tmp_path: Path, capsys):
    target = tmp_path / "planes.glb"
    target.write_text("mine")
    said = refused(capsys, "export", run, "--to", target)
    assert "planes.glb: exists already; give --overwrite to replace it" in said and target.read_text() == "mine"
    assert command("export", run, "--to", target, "--overwrite") == 0
    assert target.read_bytes()[:4] == b"glTF"


def test_of_several_targets_a_wrong_one_is_found_before_any_is_written(run: Path, tmp_path: Path, capsys):
    said = refused(capsys, "export", run, "--to", tmp_path / "a.glb", "--to", tmp_path / "b.obj")
    assert "b.obj: expected a name that ends in one of" in said and not (tmp_path / "a.glb").exists()


@pytest.mark.parametrize(
    ("spoil", "name", "sentence"),
    [
        (lambda run: None, "map.stl", r"map.stl: expected a name that ends in one of .ply, .glb, .g2o, .tum, .kitti"),
        (lambda run: (run / "planes.json").unlink(), "a.ply", "expected the folder of a run, found no planes.json"),
        (lambda run: (run / "planes.json").write_text("[1"), "a.ply", "planes.json:1: expected JSON"),
        (lambda run: (run / "trajectory.tum").unlink(), "a.tum", "trajectory.tum: cannot be read"),
        (lambda run: (run / "graph.g2o").unlink(), "a.g2o", "expected the graph of a run with poses estimated"),
        (lambda run: (run / "graph.g2o").write_text("x"), "a.g2o", "graph.g2o:1: expected one of VERTEX_SE3"),
        (lambda run: (run / "view.json").write_text("{}"), "a.glb", "view.json: expected the format"),
        (lambda run: (run / "metrics.json").write_text("7"), "a.glb", "expected the metrics.json of a run"),
        (lambda run: (run / "a.glb").mkdir(), "a.glb", "expected a file to write, got a folder"),
    ],
)
def test_what_is_wrong_is_one_sentence(run: Path, spoil, name: str, sentence: str):
    spoil(run)
    before = sorted(run.iterdir())
    with pytest.raises(ValueError, match=sentence):
        export_run(run, run / name)
    assert sorted(run.iterdir()) == before


def test_a_broken_history_is_refused(run: Path):
    good = json.loads((run / "view.json").read_text())
    for key, value in (
        ("seen", {"7": {"type": "Blob"}}),
        ("nis", {"plane": [[1, 2.0]]}),
        ("nis", {"plane": [[1, "x", 3]]}),
        ("kinds", [1]),
        ("pose_covariances", {"0": [[1.0]]}),
        *(("points_cm", wrong) for wrong in ([1, 2], {}, [1, 2, "x"], [1, 2, float("inf")])),
    ):
        (run / "view.json").write_text(json.dumps({**good, key: value}))
        with pytest.raises(LogError, match=r"expected the view\.json of a run"):
            History.read(run / "view.json")


def test_a_run_is_read_back_as_it_was_and_planes_json_byte_for_byte(run: Path):
    stored = StoredRun.read(run)
    for read, given in zip(stored.planes, two_planes(), strict=True):
        assert (read.id, read.observations, read.kinds) == (given.id, given.observations, given.kinds)
        assert shapely.equals_exact(read.seen, given.seen, 0.0)
        for name in ("frame", "covariance", "d", "n_points"):
            np.testing.assert_array_equal(getattr(read.plane, name), getattr(given.plane, name))
        assert (read.plane.outline is None) == (given.plane.outline is None)
    assert stored.history.nis == {"plane": [(1, 2.5, 3), (2, 4.5, 3)]}
    np.testing.assert_array_equal(stored.history.pose_covariances[2], np.eye(6) * 1e-4)
    assert stored.tables == [("the run", [Metric("planes", 2, "")])]
    assert len(stored.trajectory) == 3 and len(stored.odometry) == 0
    write_planes(run / "again.json", stored.planes)
    assert (run / "again.json").read_bytes() == (run / "planes.json").read_bytes()


def test_ply_is_a_mesh_without_open3d(run: Path):
    mesh = read_tables(run / "map.ply")
    given = mesh_of(two_planes())
    np.testing.assert_array_equal(np.column_stack([mesh["vertex"][axis] for axis in "xyz"]), given.vertices)
    np.testing.assert_array_equal(mesh["face"]["vertex_indices"], given.triangles)
    np.testing.assert_array_equal(mesh["vertex"]["plane"], given.plane_ids)


def glb_parts(file: Path) -> tuple[dict, bytes]:
    data = file.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    if not rest:
        return document, b""
    binary_size, kind = struct.unpack_from("<I4s", rest)
    assert kind == b"BIN\0" and binary_size % 4 == 0 and len(rest) == 8 + binary_size
    return document, rest[8:]


def test_glb_is_laid_out_as_the_specification_asks(tmp_path: Path):
    """glTF 2.0: chunk lengths, buffer views inside the buffer and aligned, bounds of positions, indices in range."""
    write_glb(tmp_path / "map.glb", two_planes())
    document, binary = glb_parts(tmp_path / "map.glb")
    assert document["asset"]["version"] == "2.0"
    assert document["buffers"] == [{"byteLength": len(binary)}]
    sizes = {5126: 4, 5125: 4, 5121: 1}
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        length = accessor["count"] * sizes[accessor["componentType"]] * widths[accessor["type"]]
        assert view["byteLength"] == length and view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + length <= len(binary)
    for node in document["nodes"][1:]:
        (primitive,) = document["meshes"][node["mesh"]]["primitives"]
        position = document["accessors"][primitive["attributes"]["POSITION"]]
        view = document["bufferViews"][position["bufferView"]]
        corners = np.frombuffer(binary, "<f4", position["count"] * 3, view["byteOffset"]).reshape(-1, 3)
        assert position["min"] == corners.min(axis=0).tolist() and position["max"] == corners.max(axis=0).tolist()
        index = document["accessors"][primitive["indices"]]
        at = document["bufferViews"][index["bufferView"]]["byteOffset"]
        assert np.frombuffer(binary, "<u4", index["count"], at).max() < position["count"]
        assert document["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True
    extras = document["nodes"][1]["extras"]
    assert extras["id"] == 7 and extras["d"] == wall().plane.d and extras["sigma_m"] == pytest.approx(1e-3)


@needs_open3d
def test_open3d_reads_the_glb(tmp_path: Path):
    given = mesh_of([wall()])
    write_glb(tmp_path / "map ü.glb", [wall()])
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "map ü.glb"))
    x, y, z = np.asarray(mesh.vertices).T  # y up there
    gaps = np.linalg.norm(np.column_stack((x, -z, y))[:, None] - given.vertices, axis=2)  # it joins equal corners
    assert gaps.min(axis=0).max() < 1e-6 and gaps.min(axis=1).max() < 1e-6
    assert mesh.get_surface_area() == pytest.approx(WINDOW.area, rel=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors)[0], given.colours[0] / 255.0, atol=1 / 255)
    mesh.compute_triangle_normals()
    normal = wall().plane.normal[[0, 2, 1]] * [1.0, 1.0, -1.0]
    np.testing.assert_allclose(np.asarray(mesh.triangle_normals), np.tile(normal, (len(mesh.triangles), 1)), atol=1e-5)


def test_far_from_the_origin_single_precision_is_enough_and_an_empty_map_is_a_valid_glb(tmp_path: Path):
    far = wall(frame=wall().plane.frame + np.pad([[1e6], [2e6], [0]], ((0, 1), (3, 0))))
    write_glb(tmp_path / "far.glb", [far])
    document, _ = glb_parts(tmp_path / "far.glb")
    assert document["nodes"][1]["translation"] == far.plane.centre.tolist()
    assert max(np.abs(document["accessors"][0]["max"])) < 3.0
    write_glb(tmp_path / "empty.glb", [])
    document, binary = glb_parts(tmp_path / "empty.glb")
    assert binary == b"" and document["scenes"] == [{"nodes": [0]}]
    assert not {"meshes", "buffers", "accessors", "materials"} & set(document)  # empty lists are not allowed
