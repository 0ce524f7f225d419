"""One door for every kind of log: what it is, how it is read, and the rig it comes with when none is given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.errors import LogError, check_cloud_given, check_log_given
from slam.io import default_rigs as rigs
from slam.io.carmen import read_carmen
from slam.io.cloud_folders import clouds_in, has_clouds, read_cloud_folder, read_e57_log
from slam.io.clouds import is_cloud_file, read_cloud
from slam.io.clouds.cloud import grid_of
from slam.io.clouds.depth import is_depth_folder, read_depth_folder
from slam.io.plausibility import plausible
from slam.io.rosbags.reader import Topics, is_rosbag, read_rosbag
from slam.io.scan_files import first_file, with_odometry
from slam.io.threedtk import is_3dtk_folder, is_3dtk_scan, read_3dtk
from slam.io.threedtk import read_points as read_3dtk_points
from slam.sensors.log import CloudScan, Log
from slam.sensors.rig import Rig
from spplanes._check import FloatArray
from spplanes.clouds.arrange import arrange, shows_lines
from spplanes.clouds.turn import told_turn


def load(
    path: Path,
    rig: Rig | None = None,
    *,
    keep_partial: bool = False,
    topics: Topics | None = None,
    odometry: Path | None = None,
) -> tuple[Log, Rig]:
    """Read a log of any known kind.

    Known are ROS bags, folders of 3DTK scans, folders of clouds (`slam.io.cloud_folders`) and of depth images
    (`slam.io.clouds.depth`), E57 files, folders made by `spplanes simulate` (log.clf.gz beside rig.yaml), and
    CARMEN logs, plain or gzip.

    Args:
        path: the log.
        rig: the sensors; None: the rig in the folder, or a default for the kind of log.
        keep_partial: of a log that breaks off use what comes before.
        topics: of a bag; None: chosen, and said in the log's notes.
        odometry: a TUM file of odom_T_body in place of the log's own odometry; None: the log's own, if it has any. Of
            depth images a file of the camera's poses by its name (`groundtruth.txt`, `poses.tum`) is moved to the body.

    Returns:
        The log, and the rig: the one given, the one in the folder, or a default for the kind of log.

    Raises:
        LogError: nothing there, or nothing known; or what the reader of its kind says.
    """
    path = Path(path)
    check_log_given(path)
    if rig is None and (path / "rig.yaml").is_file():
        rig = Rig.from_yaml(path / "rig.yaml")
    log, sensors = _load(path, rig, keep_partial, topics or Topics(), odometry)
    if odometry is not None and log.odometry_source is None:
        log = with_odometry(log, odometry)
    log = plausible(log, sensors)
    if rig is None:
        log.assumed.extend(rigs.assumptions(log, sensors))
    return log, sensors


def load_cloud(path: Path) -> tuple[Log, Rig]:
    """One cloud, of any format that `slam.io.clouds` or `slam.io.threedtk` reads, as a log of one scan.

    Returns:
        The log, and the rig that is assumed for such clouds, as `load` would for a folder of them.

    Raises:
        LogError: no such file, or what the reader of its format says.
    """
    path = Path(path)
    check_cloud_given(path)
    if is_3dtk_scan(path):
        points, rig = read_3dtk_points(path), rigs.threedtk_rig()
    else:
        cloud = read_cloud(path)
        points, rig = cloud.points, rigs.depth_rig() if cloud.is_depth_image else _rig_by_order(cloud.points)
    ((name, sensor),) = rig.sensors.items()
    log = plausible(Log([CloudScan(0, name, arrange(points, grid_of(sensor)), turn=told_turn(points))], path), rig)
    log.assumed.extend(rigs.assumptions(log, rig))
    return log, rig


def _load(path: Path, rig: Rig | None, keep_partial: bool, topics: Topics, odometry: Path | None) -> tuple[Log, Rig]:
    """By the reader of its kind; clouds and depth images with the odometry given, which is theirs in its own ways."""
    if is_rosbag(path):
        return _load_bag(path, rig, topics, keep_partial)
    if topics != Topics():
        raise LogError(path, "expected a bag where topics or frames are given, got a log without them")
    if path.is_dir():
        return _load_folder(path, rig, keep_partial, odometry)
    if path.suffix.lower() == ".e57":
        return _of_one_sensor(path, rig or rigs.cloud_rig(), read_e57_log)
    if is_cloud_file(path) and path.suffix.lower() not in (".txt", ".csv"):
        raise LogError(path, "expected a log, got one cloud: give it to `spplanes fit`, or a folder of clouds")
    return _load_carmen(path, rig, keep_partial)


def _load_folder(path: Path, rig: Rig | None, keep_partial: bool, odometry: Path | None) -> tuple[Log, Rig]:
    """A mission, the scans of 3DTK, depth images, clouds: the first that is there, and a note where others are too."""
    mission = first_file(path, ("log.clf.gz", "log.clf"))
    if mission is None and (path / "planes.json").is_file():
        raise LogError(path, "expected a log, got the folder of a run")
    kinds: dict[str, Callable[[], tuple[Log, Rig]]] = {}
    if mission is not None:
        kinds["a mission's log"] = lambda: _load_carmen(mission, rig, keep_partial)
    if is_3dtk_folder(path):
        kinds["3DTK scans"] = lambda: (read_3dtk(path), rig or rigs.threedtk_rig())
    if is_depth_folder(path):
        kinds["depth images"] = lambda: _of_one_sensor(path, rig or rigs.depth_rig(), read_depth_folder, odometry)
    if has_clouds(path, surely=bool(kinds)):
        kinds["clouds"] = lambda: _of_one_sensor(path, rig or _rig_of_clouds(path), read_cloud_folder, odometry)
    if kinds:
        first, *others = kinds
        log, rig_of_log = kinds[first]()
        if others:
            log.notes.append(f"read {first}, left out {' and '.join(others)} in the same folder")
        return log, rig_of_log
    bags = sorted(entry.name for entry in path.iterdir() if is_rosbag(entry))
    if bags:
        raise LogError(path, f"expected one log, got a folder of {len(bags)} bags: give one of them, such as {bags[0]}")
    raise LogError(path, "expected a folder with clouds, scanNNN.3d files, a bag or log.clf.gz, found none")


def _load_carmen(path: Path, rig: Rig | None, keep_partial: bool) -> tuple[Log, Rig]:
    log = read_carmen(path, rig=rig, keep_partial=keep_partial)
    return log, rig or rigs.default_rig_for(log)


def _load_bag(path: Path, rig: Rig | None, topics: Topics, keep_partial: bool) -> tuple[Log, Rig]:
    if rig is None:
        log = read_rosbag(path, topics, keep_partial=keep_partial)
        return log, rigs.bag_rig(log, topics)
    given = {"body_frame": topics.body_frame} if topics.body_frame else {}
    if topics.odometry or topics.odometry_frame:
        given |= {"odometry_record": topics.odometry, "odometry_frame": topics.odometry_frame}
    rig = rig.model_copy(update=given)  # what is given stands in for what the rig says, for a resumed run too
    wanted = Topics(topics.scans, rig.odometry_record, rig.odometry_frame, rig.body_frame)
    return read_rosbag(path, wanted, rig=rig, keep_partial=keep_partial), rig


def _rig_of_clouds(folder: Path) -> Rig:
    """For clouds nobody describes, by the first of them."""
    try:
        return _rig_by_order(read_cloud(clouds_in(folder)[0][0]).points)
    except LogError:  # a cloud that cannot be read is left out when its turn comes
        return rigs.cloud_rig()


def _rig_by_order(points: FloatArray) -> Rig:
    """Of a turned laser where the order of the points shows its lines."""
    return rigs.turned_laser_rig() if shows_lines(points) else rigs.cloud_rig()


def _of_one_sensor(path: Path, rig: Rig, read: Callable[..., Log], *odometry: Path | None) -> tuple[Log, Rig]:
    """The scans of the one 3D sensor in a rig, by the reader of their kind."""
    sensors = rig.of_kind("cloud")
    if len(sensors) != 1:
        raise LogError(path, f"expected a rig with one sensor of kind cloud for these scans, got {len(sensors)}")
    ((name, sensor),) = sensors.items()
    return read(path, name, sensor, *odometry), rig
