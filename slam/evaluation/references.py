"""What a run is compared with: a trajectory as a file tells it, brought to the run's body and, if asked, its times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.folders.depth_images import CAMERA_POSES, is_depth_folder
from slam.io.trajectories import Trajectory, read_tum
from slam.sensors.rig import Rig
from slam.session.state import session_path
from slam.session.store import Session
from spplanes._check import FloatArray

#: What `truth_of` says beside the name of a sensor.
BODY, SENSOR = "body", "sensor"


@dataclass(frozen=True, eq=False)
class Reference:
    """A trajectory to compare a run with."""

    trajectory: Trajectory
    """world_T_body, in a world of its own."""
    notes: tuple[str, ...] = ()
    """What was done to it, one sentence each."""


def best_path(run: Path) -> Path:
    """The run's poses at every scan, else at its keyframes: runs of earlier versions have no scans.tum."""
    scans = run / "scans.tum"
    return scans if scans.is_file() else run / "trajectory.tum"


def read_reference(run: Path, truth: Path, *, truth_of: str | None = None, by_row: bool = False) -> Reference:
    """A TUM file as a trajectory of the run's body.

    Args:
        run: the folder of the run.
        truth: the file.
        truth_of: what its poses are of: "body", "sensor" (the run's only one), or a sensor by its name in the run's
            rig; None: of the camera, where the file is the `groundtruth.txt` or `poses.tum` of depth images (beside
            them or one folder down, or those that the run was made from), else of the body.
        by_row: its poses are the run's one by one, whatever their times: clouds that tell no time are numbered.

    Raises:
        LogError: a file that cannot be read.
        ValueError: no such sensor, or, by row, not as many poses as the run has.
    """
    poses, notes = read_tum(truth), []
    if truth_of is None:
        truth_of = SENSOR if _is_of_camera(run, truth) else BODY
    if truth_of != BODY:
        name, body_T_sensor = _sensor(run, truth_of)
        poses = Trajectory(poses.stamps_ns, poses.poses @ inverse(body_T_sensor))
        notes.append(f"{truth.name} is of the sensor {name!r}: moved to the body by the mount in the run's rig")
    if by_row:
        stamps = read_tum(best_path(run)).stamps_ns
        if len(poses) != len(stamps):
            raise ValueError(f"{truth}: expected, by row, as many poses as the run's {len(stamps)}, got {len(poses)}")
        poses = Trajectory(stamps, poses.poses)
        notes.append(f"{truth.name} was taken row by row, whatever its times")
    return Reference(poses, tuple(notes))


def _is_of_camera(run: Path, truth: Path) -> bool:
    if truth.name not in CAMERA_POSES:
        return False
    place = truth.resolve().parent
    return any(is_depth_folder(folder) for folder in (place, place.parent)) or _was_of_depth_images(run)


def _was_of_depth_images(run: Path) -> bool:
    """Whether the session says that the run was made from depth images, and they are still there."""
    if not session_path(run).is_file():
        return False
    with Session.open(run, read_only=True) as session:
        log = session.log
    return log is not None and is_depth_folder(Path(log["path"]))


def _sensor(run: Path, wanted: str) -> tuple[str, FloatArray]:
    """Name and body_T_sensor (4, 4) of a sensor of the run's rig."""
    path = run / "rig.yaml"
    if not path.is_file():
        raise LogError(path, "expected the rig of the run, found none: a truth of a sensor cannot be moved to the body")
    sensors = Rig.from_yaml(path).sensors
    there = ", ".join(sensors)
    if wanted == SENSOR and len(sensors) != 1:
        raise ValueError(f"truth_of: expected the name of one of the run's sensors ({there}), got {SENSOR!r}")
    name = next(iter(sensors)) if wanted == SENSOR else wanted
    if name not in sensors:
        raise ValueError(f"truth_of: expected {BODY!r}, {SENSOR!r} or one of the run's sensors ({there}), got {name!r}")
    return name, sensors[name].body_T_sensor
