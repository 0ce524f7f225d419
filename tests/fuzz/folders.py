"""Readers of what other programs wrote, natively or in several files: bags, LAS, E57, depth images, folders, runs."""

import io
import struct
import tempfile
from contextlib import closing
from dataclasses import replace
from functools import cache, partial
from itertools import islice, product
from pathlib import Path

import numpy as np

from factors.association.observations import LineObservation
from slam.config import SlamConfig
from slam.errors import LogError
from slam.frontend.keyframes import Keyframe
from slam.io.carmen import write_carmen
from slam.io.clouds import read_cloud
from slam.io.default_rigs import cloud_rig
from slam.io.load import load
from slam.io.planes_json import write_planes
from slam.io.trajectories import Trajectory, write_tum
from slam.planeslam import PlaneSlam
from slam.runs.cloud_fit import fit_cloud
from slam.runs.history import History
from slam.runs.stored_run import StoredRun
from slam.sensors.log import Log, OdometryReading
from slam.session._codec import encode, keyframe_of, without_scans
from slam.session.prior_map import PriorMap
from slam.session.store import Session, salvage_session
from slam.simulation import simulate_mission
from slam.simulation.record import Truth
from spplanes import ScanLine
from tests.fuzz.target import Target, check_log, check_planes, check_points, check_poses, folded, unfolded, written
from tests.fuzz.wrapping import e57, png, record, unrecorded, zipped
from tests.slam.io.bags import Messages, write
from tests.slam.io.test_clouds import npy, npz, pcd
from tests.slam.io.test_las_e57 import write_e57, write_las
from tests.slam.io.test_rosbag import mission
from tests.slam.scenes import drive, room_planes

_POINTS = np.random.default_rng(0).normal((10.0, 20.0, 5.0), 3.0, (40, 3))
_RUN = ("planes.json", "trajectory.tum", "view.json", "metrics.json", "odometry.tum")
_BAG = ("metadata.yaml", "run 1 ü.db3")
_TRUTH = ("planes.json", "trajectory.tum", "labels.npz")
_CLOUDS = ("times.txt", "poses.tum", "odometry.tum", "rig.yaml", "scan 1.pcd", "scan 2.pcd")
_DEPTH = ("intrinsics.txt", "depth.txt", "groundtruth.txt", "depth/a1.png", "depth/a2.png")


def _bag(path: Path) -> None:
    """As a whole bag, and for what comes before a break in it."""
    try:
        check_log(load(path)[0])
    except LogError:
        check_log(load(path, keep_partial=True)[0])


def _log_folder(names: tuple[str, ...]):
    def read(path: Path) -> None:
        check_log(load(unfolded(path, names))[0])

    return read


def check_cloud(path: Path) -> None:
    check_points(read_cloud(path).points)


def _image(path: Path) -> None:
    (path.parent / "intrinsics.txt").write_text("525 525 319.5 239.5\n")
    check_cloud(path)


def _run(path: Path) -> None:
    run = StoredRun.read(unfolded(path, _RUN))
    check_planes(*(known.plane for known in run.planes))
    check_poses(run.trajectory.poses)


def _truth(path: Path) -> None:
    check_planes(*Truth.read(unfolded(path, _TRUTH)).planes)


def _prior(path: Path) -> None:
    """What can be a prior can begin a mission."""
    slam = PlaneSlam(prior=PriorMap.load(path))
    slam.add_keyframe(_first_keyframe())
    check_poses(slam.trajectory.poses)


@cache
def _first_keyframe() -> Keyframe:
    return drive(0, count=1).keyframes[0]


def _prior_bytes(path: Path) -> None:
    prior = PriorMap.from_bytes(path.read_bytes())
    check_poses(prior.world_T_start)
    PlaneSlam(prior=prior)


def _keyframe_bytes(path: Path) -> None:
    """What a session hands a run that goes on."""
    keyframe = keyframe_of(path.read_bytes())
    slam = PlaneSlam()
    if keyframe.motion is not None:
        slam.add_keyframe(_first_keyframe())
    slam.add_keyframe(keyframe)
    check_poses(slam.trajectory.poses)


def _fit(path: Path) -> None:
    check_planes(*fit_cloud(read_cloud(path), path).planes)


def _salvage(path: Path) -> None:
    """What is saved of a session is one."""
    for left in path.parent.glob(f"{path.name}?*"):
        left.unlink()
    salvage_session(path)
    with Session.open(path) as session:
        assert all(entry.keyframe.stamp_ns >= 0 for entry in session.entries())


def _level(messages: Messages):
    """A robot whose mount and way tf tells, with a level laser."""
    yield "/tf", 0, messages.tf("base_link", "laser", np.eye(4))
    for stamp in (10**9, 2 * 10**9):
        yield "/tf", stamp, messages.tf("odom", "base_link", np.eye(4), stamp)
        yield "/scan", stamp, messages.scan(stamp, np.array([1.0, 2.0, 30.0]))


def _bag_seeds(*kinds: str) -> list[bytes]:
    """A robot with a 3D laser and odometry, and one with a level laser and tf."""
    seeds = []
    for kind, make in product(kinds, (lambda messages: islice(mission(messages, columns=8), 5), _level)):
        with tempfile.TemporaryDirectory() as folder:
            path = write(Path(folder), kind, make)
            if path.is_dir():
                seeds.append(folded(*((path / name).read_bytes() for name in _BAG)))
            else:
                seeds.append(path.read_bytes())
    return seeds


def _las(name: str) -> list[bytes]:
    return [written(partial(write_las, points=_POINTS), name)]


def _e57_seeds() -> list[bytes]:
    scans = [(_POINTS.reshape(5, 8, 3), pose) for pose in (np.eye(4), None)]
    makers = [partial(write_e57, scans=scans, organised=ordered) for ordered in (False, True)]
    return [written(make, "a.e57") for make in makers]


def _png() -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.arange(5000, 5000 + 12 * 16, dtype=np.uint16).reshape(12, 16)).save(stream, "png")
    return stream.getvalue()


def _pixel_seeds() -> list[bytes]:
    """Header and rows of images of 4 by 3 pixels: depth in two bytes, grey in one, colours, a palette's indices."""
    kinds = ((16, 0, 2), (8, 0, 1), (8, 2, 3), (16, 6, 8), (1, 0, 1))
    return [
        struct.pack(">IIBBBBB", 4, 3, depth, colour, 0, 0, 0) + 3 * (b"\0" + bytes(range(1, 1 + 4 * size)))
        for depth, colour, size in kinds
    ]


def _member_seeds() -> list[bytes]:
    return [folded(npy(_POINTS[:6]), npy(np.eye(4))), folded(npy(_POINTS[:6].reshape(2, 3, 3).astype(">f4")))]


def _pcd() -> bytes:
    return pcd(n=40, body=_POINTS.astype("<f4").tobytes()).replace(b"VIEWPOINT 0", b"VIEWPOINT 1")


def tum(count: int) -> bytes:
    trajectory = Trajectory(np.arange(count) * 10**9, drive(0, count=count).world_T_body)
    return written(lambda path: write_tum(path, trajectory), "t.tum")


def _cloud_folder_seeds() -> list[bytes]:
    return [folded(b"0.0\n1.0\n", tum(2), tum(2), written(cloud_rig().to_yaml, "rig.yaml"), _pcd(), _pcd())]


def _depth_seeds() -> list[bytes]:
    return [folded(b"525 525 8 6\n", b"0.0 depth/a1.png\n1.0 depth/a2.png\n", tum(2), _png(), _png())]


def _mission_seeds() -> list[bytes]:
    made = simulate_mission("room", n_scans=2, seed=0)
    log = Log([event for event in made.log.events if isinstance(event, OdometryReading)][:4], Path("x"))
    log.events.extend(made.log.scans()[:2])
    log.events.sort(key=lambda event: event.stamp_ns)
    rig = written(made.rig.to_yaml, "rig.yaml")
    return [folded(rig, written(partial(write_carmen, log, made.rig), "log.clf"))]


def _planes() -> bytes:
    """Planes of a room that are known to a few millimetres."""
    planes = [replace(plane, covariance=1e-5 * np.eye(3)) for plane in room_planes()]
    return written(partial(write_planes, planes=planes), "planes.json")


def _run_seeds() -> list[bytes]:
    history = written(lambda path: History(nis={"plane": [(0, 1.5, 3)]}).write(path), "view.json")
    metrics = b'{"metrics": [{"metric": "scans", "value": 3, "unit": "1"}]}'
    return [folded(_planes(), tum(3), history, metrics, tum(3))]


def _truth_seeds() -> list[bytes]:
    return [folded(_planes(), tum(3), npz(laser=np.zeros((2, 5), dtype=np.int32)))]


def _prior_seeds() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "planes.json").write_bytes(_planes())
        return [unrecorded(PriorMap.load(Path(folder) / "planes.json").to_bytes())]


def _keyframe_seeds() -> list[bytes]:
    line = ScanLine(0.3, 2.0, 1e-4 * np.eye(2), np.array([[1.9, 0.6], [1.6, 1.5]]), np.arange(9))
    first, second = drive(0, count=2).keyframes
    lines = Keyframe(second.stamp_ns, [LineObservation(line, np.eye(4))], second.motion, returns=np.ones((3, 4)))
    return [unrecorded(encode(without_scans(one))) for one in (first, second, lines)]


def session_seeds() -> list[bytes]:
    def make(path: Path) -> None:
        with closing(Session.create(path, SlamConfig())) as session:
            for index, keyframe in enumerate(drive(0, count=2).keyframes):
                session.add_keyframe(keyframe)
                session.add_decisions(index, [])

    return [written(make, "session.db")]


FOLDERS = (
    Target("bag.ros1", _bag, lambda: _bag_seeds("ros1", "ros1 bz2", "ros1 lz4"), ".bag"),
    Target("bag.mcap", _bag, lambda: _bag_seeds("mcap alone", "mcap zstd alone"), ".mcap"),
    Target("bag.db3", _bag, lambda: _bag_seeds("db3 alone"), ".db3"),
    Target("bag.folder", _log_folder(_BAG), lambda: _bag_seeds("sqlite3")),
    Target("cloud.las", check_cloud, lambda: _las("a.las"), ".las"),
    Target("cloud.laz", check_cloud, lambda: _las("a.laz"), ".laz"),
    Target("cloud.e57", lambda path: check_log(load(path)[0]), _e57_seeds, ".e57", e57),
    Target("cloud.png", _image, lambda: [_png()], ".png"),
    Target("cloud.png-pixels", _image, _pixel_seeds, ".png", png),
    Target("cloud.npz-members", check_cloud, _member_seeds, ".npz", zipped("points.npy", "other.npy")),
    Target("clouds", _log_folder(_CLOUDS), _cloud_folder_seeds),
    Target("depth", _log_folder(_DEPTH), _depth_seeds),
    Target("mission", _log_folder(("rig.yaml", "log.clf")), _mission_seeds),
    Target("fit", _fit, lambda: [_pcd()], ".pcd"),
    Target("run", _run, _run_seeds),
    Target("truth", _truth, _truth_seeds),
    Target("prior", _prior, lambda: [_planes()], ".json"),
    Target("prior-bytes", _prior_bytes, _prior_seeds, wrap=record),
    Target("keyframe-bytes", _keyframe_bytes, _keyframe_seeds, wrap=record),
    Target("salvage", _salvage, session_seeds, ".db"),
)
