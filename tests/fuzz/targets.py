"""What is fuzzed: every reader, and the public functions that take arrays; a few valid inputs of each to start from.

Any bytes must lead to an answer that holds together or to a ValueError of one sentence.
"""

import gzip
import json
from functools import cache, partial
from pathlib import Path

import numpy as np

from slam.config import SlamConfig
from slam.evaluation.trajectories import read_relations
from slam.io.carmen import read_carmen, write_carmen
from slam.io.g2o.reader import read_g2o
from slam.io.planes_json import read_planes, write_planes
from slam.io.threedtk import read_3dtk
from slam.io.trajectories import read_kitti, read_tum, write_kitti
from slam.sensors.rig import Rig
from slam.session._codec import decode, encode, without_scans
from slam.session.store import Session
from slam.simulation import simulate_mission
from slam.simulation.robots import paper_rig
from spplanes import Plane
from tests.fuzz.folders import FOLDERS, check_cloud, session_seeds, tum
from tests.fuzz.public import PUBLIC
from tests.fuzz.target import Target, check_log, check_planes, check_poses, written
from tests.slam.io.test_clouds import CLOUD_FILES
from tests.slam.scenes import drive, room_planes


def _config(path: Path) -> None:
    config = SlamConfig.from_yaml(path)
    again = path.with_name("again.yaml")
    again.write_text(config.to_yaml(), encoding="utf-8")
    assert SlamConfig.from_yaml(again) == config


def _rig(path: Path) -> None:
    rig = Rig.from_yaml(path)
    again = path.with_name("again.yaml")
    rig.to_yaml(again)
    assert Rig.from_yaml(again) == rig


def _tum(path: Path) -> None:
    trajectory = read_tum(path)
    assert (np.diff(trajectory.stamps_ns) > 0).all()
    check_poses(trajectory.poses)


def _planes(path: Path) -> None:
    for plane in read_planes(path):
        check_planes(plane)
        assert Plane.from_dict(plane.to_dict()).to_dict() == plane.to_dict()


def _plane_dict(path: Path) -> None:
    try:
        data = json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("too deep") from error
    check_planes(Plane.from_dict(data))


def _g2o(path: Path) -> None:
    found = read_g2o(path)
    assert found.poses and np.isfinite(found.graph.error(found.values))


def _threedtk(path: Path) -> None:
    """The scan and its pose in one file, a NUL between them."""
    scan, _, pose = path.read_bytes().partition(b"\0")
    folder = path.parent / "scans"
    folder.mkdir(exist_ok=True)
    (folder / "scan000.3d").write_bytes(scan)
    (folder / "scan000.pose").write_bytes(pose)
    check_log(read_3dtk(folder))


def _codec(path: Path) -> None:
    value = decode(path.read_bytes())
    assert encode(decode(encode(value))) == encode(value)


def _session(path: Path) -> None:
    """What is read of a session, however broken, was written: its checksums hold."""
    for suffix in ("-wal", "-shm", "-lock"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    with Session.open(path, read_only=True) as session:
        for entry in session.entries():
            assert entry.keyframe.stamp_ns >= 0


@cache
def _carmen_seeds() -> list[bytes]:
    mission = simulate_mission("room", n_scans=3, seed=0)
    text = written(lambda path: write_carmen(mission.log, mission.rig, path), "log.clf")
    flaser = b"PARAM robot_frontlaser_offset 0.2\nODOM 1 2 0.5 0 0 0 1.5 host 1.5\n" + b"".join(
        b"FLASER 3 1.0 2.0 81.91 1 2 0.5 0.8 2 0.5 %d.25 host %d.25\n" % (i, i) for i in range(2, 5)
    )
    whole = b"".join(text.splitlines(keepends=True)[:6])
    return [whole, gzip.compress(whole), flaser]


def _kitti_seeds() -> list[bytes]:
    return [written(lambda path: write_kitti(path, drive(0, count=4).world_T_body), "k.txt")]


def _codec_seeds() -> list[bytes]:
    return [encode(without_scans(drive(0, count=2).keyframes[1])), encode([1, (2.5, "x"), {"a": np.arange(3)}])]


def _cloud_seeds(suffix: str) -> list[bytes]:
    return [data for name, data in CLOUD_FILES.items() if name.endswith(suffix)]


def _g2o_seeds() -> list[bytes]:
    information = " ".join("1" if row == column else "0" for row in range(6) for column in range(row, 6))
    lines = [
        "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1",
        "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1",
        "VERTEX_SE3:QUAT 9 0 0 0 0 0 0 1",
        "VERTEX_PLANE 2 0 0 1 -1.5 0 0 0",
        "FIX 0 9",
        f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {information}",
        "EDGE_SE3_PLANE_CALIB 0 2 9 0 0 1 -1.5 0 0 0 100 0 0 100 0 100",
    ]
    return [("\n".join(lines) + "\n").encode()]


CLOUDS = (".pcd", ".ply", ".bin", ".npy", ".npz", ".xyz", ".csv", ".pts")

TARGETS = {
    target.name: target
    for target in (
        Target("carmen", lambda path: check_log(read_carmen(path)), _carmen_seeds, ".clf"),
        Target("carmen-rig", lambda path: check_log(read_carmen(path, rig=paper_rig())), _carmen_seeds, ".clf"),
        Target("3dtk", _threedtk, lambda: [b"100 200 300\n110 200 300\n\x000 0 0\n0 0 0\n"]),
        Target("tum", _tum, lambda: [tum(4)]),
        Target("kitti", lambda path: check_poses(read_kitti(path)), _kitti_seeds),
        Target("relations", lambda path: check_poses(read_relations(path).a_T_b), lambda: [b"1.5 2.5 1 0 0 0 0 0.1\n"]),
        Target("planes", _planes, lambda: [written(lambda path: write_planes(path, room_planes()), "planes.json")]),
        Target("g2o", _g2o, _g2o_seeds, ".g2o"),
        Target("rig", _rig, lambda: [written(lambda path: paper_rig().to_yaml(path), "rig.yaml")], ".yaml"),
        Target("config", _config, lambda: [SlamConfig().to_yaml().encode(), b"mapper: {}\n"], ".yaml"),
        Target("codec", _codec, _codec_seeds),
        Target("session", _session, session_seeds, ".db"),
        Target("Plane.from_dict", _plane_dict, lambda: [json.dumps(room_planes()[0].to_dict()).encode()]),
        *PUBLIC,
        *FOLDERS,
        *(Target(f"cloud{suffix}", check_cloud, partial(_cloud_seeds, suffix), suffix) for suffix in CLOUDS),
    )
}
