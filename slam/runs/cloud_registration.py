"""Registration of two clouds: the pose of one in the other, its covariance, its rivals, and a verdict on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from factors._conventions import POSE3_TO_SP
from slam.backend.joint_covariance import carried
from slam.config import SlamConfig
from slam.diagnostics.evidence.registration import judge
from slam.diagnostics.verdict import Verdict
from slam.errors import LogError
from slam.frontend.keyframes import Keyframe, keyframes_of
from slam.frontend.range_noise import with_shown_errors
from slam.geometry.frames import inverse
from slam.io.load import load_cloud
from slam.runs.scan_pairs import Place, Refined, Rival, find_place, refined
from slam.sensors.log import CloudScan
from slam.sensors.rig import Sensor
from slam.tracking.bent_pair import BentCloud, Straightened, straightened
from spplanes._check import FloatArray, as_transform
from spplanes.spmodel import rpy_from_transform, transform_from_rpy


@dataclass(frozen=True, eq=False)
class Registration:
    """The pose of cloud B in the frame of cloud A."""

    a_T_b: FloatArray
    """Takes points of B to A, shape (4, 4)."""
    covariance: FloatArray
    """Of its SP differential (x, y, z, phi, theta, psi), on the right as in `factors.relative_pose_factor`, (6, 6)."""
    n_planes: int
    """Planes that both clouds have."""
    open: tuple[str, ...]
    """One sentence for each direction, in the frame of A, that the planes leave open."""
    verdict: Verdict
    """Sound, doubtful or broken, and why."""
    rivals: tuple[Rival, ...]
    """Other places that were looked at, the likeliest first."""
    overlap: float
    """Share of what B sees that lies on a surface that A sees."""
    bent: bool
    """Whether the lidar moved while it turned, as both clouds show: the pose is of the middles of both turns, by planes
    and returns with that motion unknown."""
    nis_per_dof: float
    """Chi2 of the planes in both, by the noise assumed for such sensors, per degree of freedom; `covariance` is scaled
    by it. NaN: too few planes to tell."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        sigmas = np.sqrt(np.diag(self.covariance))
        return {
            **_told(self.a_T_b),
            "sigma_xyz_m": sigmas[:3].tolist(),
            "sigma_ypr_deg": np.rad2deg(sigmas[3:]).tolist(),
            "covariance": self.covariance.tolist(),
            "planes": self.n_planes,
            "open": list(self.open),
            "verdict": self.verdict.verdict,
            "reasons": self.verdict.reasons,
            "rivals": [{**_told(rival.a_T_b), "probability": rival.probability} for rival in self.rivals],
            "overlap": self.overlap,
            "bent": self.bent,
            "nis_per_dof": self.nis_per_dof if np.isfinite(self.nis_per_dof) else None,
        }


def _told(pose: FloatArray) -> dict[str, list[Any]]:
    """A pose (4, 4), and as numbers for people."""
    numbers = rpy_from_transform(pose)
    return {"a_T_b": pose.tolist(), "xyz_m": numbers[:3].tolist(), "ypr_deg": np.rad2deg(numbers[3:]).tolist()}


def register_clouds(a: Path | str, b: Path | str, *, guess: FloatArray | None = None) -> Registration:
    """The pose of cloud B in the frame of cloud A, files of any format that `slam.io.load.load_cloud` reads.

    Planes propose places anywhere, all returns decide between them. From the likeliest a run of two keyframes refines
    the pose, by the planes and by what the returns on none of them add. Each cloud is in its sensor's frame, a depth
    image in its camera's. The verdict says whether that is the place, or may be another one, or another building.

    The sensors' noise is assumed, as for a folder of such clouds. What it really is the planes that both clouds have
    tell: the covariance is scaled by their chi2 (variance of unit weight). A guess is a_T_b about as it should be,
    (4, 4) or a ``gtsam.Pose3``: one more place to look at, which is not believed.

    Raises:
        LogError: a file that cannot be read.
        ValueError: no planes that both have.
    """
    files = Path(a), Path(b)
    start = None if guess is None else as_transform("guess", guess)
    (seen_a, sensor_a), (seen_b, sensor_b) = (_measured(path) for path in files)
    if start is not None:
        start = sensor_a.body_T_sensor @ start @ inverse(sensor_b.body_T_sensor)
    place = find_place(seen_a, seen_b, start)
    if place is not None and (fit := refined(seen_a, seen_b, place)) is not None:
        return _registration(fit, place, (sensor_a, sensor_b))
    raise ValueError(f"{files[0].name}, {files[1].name}: expected planes that both clouds have, found none")


def _measured(path: Path) -> tuple[Keyframe, Sensor]:
    """What a cloud shows in the frame of a body that its sensor is on, and that sensor."""
    log, rig = load_cloud(path)
    rig = with_shown_errors(log, rig)
    (sensor,) = rig.sensors.values()
    return next(keyframes_of(log, rig, SlamConfig())), sensor


def _registration(fit: Refined, place: Place, sensors: Sequence[Sensor]) -> Registration:
    """What the run of two found, in the frames of the sensors."""
    a_T_b, covariance, slam = fit.a_T_b, fit.covariance, fit.run
    bent = _straightened(slam.keyframes, sensors, a_T_b)
    if bent is not None:
        a_T_b, covariance = bent.a_T_b, bent.covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    a_T_body, b_T_sensor = (inverse(sensors[0].body_T_sensor), sensors[1].body_T_sensor)
    covariance = carried(covariance, b_T_sensor)
    a_T_b, verdict = a_T_body @ a_T_b @ b_T_sensor, judge(place.match, covariance)
    open_ = tuple(stretch.sentence for stretch in slam.open_directions)
    rivals = tuple(rival._replace(a_T_b=a_T_body @ rival.a_T_b @ b_T_sensor) for rival in place.rivals)
    told = fit.n_planes, open_, verdict, rivals, place.overlap, bent is not None, fit.nis_per_dof
    return Registration(a_T_b, covariance, *told)


def _straightened(keyframes: Sequence[Keyframe], sensors: Sequence[Sensor], a_T_b: FloatArray) -> Straightened | None:
    """The pose (4, 4) again, where both clouds come in the order of a turn and are bent."""
    clouds: list[BentCloud] = []
    for frame, sensor in zip(keyframes, sensors, strict=True):
        (scan,) = frame.scans
        if frame.surfaces is None or not isinstance(scan, CloudScan) or (begin := scan.begin) is None:
            return None
        clouds.append(BentCloud(frame.surfaces, sensor, begin))
    return straightened(clouds[0], clouds[1], a_T_b)


def read_guess(text: str) -> FloatArray:
    """a_T_b (4, 4) out of X,Y,Z,YAW (m, deg), or a file of one pose: 4 x 4, 3 x 4, x y z qx qy qz qw, or a TUM line.

    ValueError, or its LogError with the file: anything else.
    """
    words = text.split(",")
    if len(words) == 4:
        try:
            x, y, z, yaw = (float(word) for word in words)
        except ValueError:
            raise ValueError(f"--guess: expected X,Y,Z,YAW or a file, got {text!r}") from None
        if not np.isfinite((x, y, z, yaw)).all():
            raise ValueError(f"--guess: expected finite numbers, got {text!r}")
        return transform_from_rpy((x, y, z, float(np.deg2rad(yaw)), 0.0, 0.0))
    path = Path(text)
    try:
        numbers = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64)
    except OSError as error:
        raise ValueError(f"--guess: expected X,Y,Z,YAW or a file that can be read, got {text!r}") from error
    except ValueError as error:
        raise LogError(path, "expected the numbers of one pose, got something else") from error
    pose = np.eye(4)
    if len(numbers) in (12, 16):
        pose[: len(numbers) // 4] = numbers.reshape(-1, 4)
    elif len(numbers) in (7, 8) and np.isfinite(numbers).all() and np.linalg.norm(numbers[-4:]) > 0.0:
        pose[:3, 3] = numbers[-7:-4]
        pose[:3, :3] = Rotation.from_quat(numbers[-4:]).as_matrix()
    else:
        raise LogError(path, f"expected one pose of 16, 12, 8 or 7 numbers, got {len(numbers)} numbers")
    try:
        return as_transform("pose", pose)
    except ValueError as error:
        raise LogError(path, str(error)) from error
