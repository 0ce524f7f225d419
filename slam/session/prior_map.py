"""Prior maps: a finished map as what the next mission knows beforehand, to localise in and to extend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from scipy.linalg import block_diag

from factors import anchored_plane_jacobian, map_prior, plane_landmark, pose_prior
from slam._field_types import check_fields
from slam.backend.estimator import Backend
from slam.errors import LogError
from slam.frontend.input_checks import check_extent
from slam.frontend.keyframes import Keyframe
from slam.io.planes_json import read_planes
from slam.map.landmarks import Landmark, LandmarkMap
from slam.map.map_planes import MapPlane
from slam.registration.initial_pose import find_start
from slam.session._codec import CodecError, decode, encode
from slam.session.store import Session, SessionError
from spplanes._check import FloatArray, as_covariance, as_transform, check_instance
from spplanes.spmodel import transform_from_rpy

#: GTSAM key of the pose in whose frame the planes of a prior map live: that of the map itself.
MAP_KEY = gtsam.symbol("m", 0)
#: Standard deviations of planes that a map can tell from none and from ignorance, m and rad.
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-9, 1e3
#: Numbers of planes are below this; GTSAM's keys have 56 bits for them, and new landmarks are counted from the last on.
_MOST_NUMBERS = 1 << 48
#: Where a mission begins when nobody says: sigmas of x and y, m, and of the heading, rad.
START_SIGMA_M, START_SIGMA_RAD = 0.3, 0.1
#: Instead of numbers: look for the start in the map.
FIND = "find"


@dataclass(frozen=True, eq=False)
class PriorMap:
    """The planes of an earlier mission, how sure they are together, and where in them the new mission starts."""

    planes: Sequence[MapPlane]
    """Planes in the world of the earlier mission, which is the world of the new one too."""
    covariance: FloatArray
    """Of the (z, theta, psi) of all planes in their frames, stacked, shape (3 N, 3 N)."""
    world_T_start: FloatArray
    """First pose of the new mission, shape (4, 4)."""
    start_covariance: FloatArray
    """Covariance (6, 6) of it in the SP order (x, y, z, phi, theta, psi), composed on the right."""

    def __post_init__(self) -> None:
        check_instance("planes", self.planes, Sequence)
        if not self.planes:
            raise ValueError("planes: expected at least one plane, got none")
        for index, known in enumerate(self.planes):
            check_instance(f"planes[{index}]", known, MapPlane)
            check_fields(f"planes[{index}]", known)
            check_extent(f"planes: plane {known.id}", known.plane.frame, known.seen)
        numbers = [known.id for known in self.planes]
        if len(set(numbers)) < len(numbers) or not 0 <= min(numbers) <= max(numbers) < _MOST_NUMBERS:
            raise ValueError(f"planes: expected each with a number of its own, got {str(sorted(numbers))[:60]}")
        size = 3 * len(self.planes)
        object.__setattr__(self, "covariance", as_covariance("covariance", self.covariance, size))
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        if sigmas.size and not _LEAST_SIGMA <= sigmas.min() <= sigmas.max() <= _LARGEST_SIGMA:
            wanted = f"standard deviations of planes from {_LEAST_SIGMA:g} to {_LARGEST_SIGMA:g}"
            raise ValueError(f"covariance: expected {wanted}, got {sigmas.min():.3g} to {sigmas.max():.3g}")
        object.__setattr__(self, "world_T_start", as_transform("world_T_start", self.world_T_start))
        covariance = as_covariance("start_covariance", self.start_covariance, 6)
        if np.linalg.eigvalsh(covariance)[0] <= 0.0:
            raise ValueError("start_covariance: expected a positive definite covariance, got a singular one")
        object.__setattr__(self, "start_covariance", covariance)

    @classmethod
    def load(
        cls, path: Path | str, *, world_T_start: FloatArray | None = None, start_covariance: FloatArray | None = None
    ) -> PriorMap:
        """The map of a finished run (its folder or session), or a planes.json.

        A run knows how its planes hang together. A planes.json has the covariance of each alone; they are then taken as
        independent, which says too much of what they share: the earlier mission's drift.

        Args:
            path: the run, or the file.
            world_T_start: where the mission starts in the map, shape (4, 4); None: where the earlier one did.
            start_covariance: of it, as in the class; None: 0.3 m and 0.1 rad on the floor.

        Raises:
            ValueError: no such file, no finished run, no planes.
        """
        path = Path(path)
        planes, covariance = _independent(path) if path.suffix == ".json" else _of_run(path)
        if not planes:
            raise LogError(path, "expected a map with planes, got none")
        start = np.eye(4) if world_T_start is None else world_T_start
        return cls(planes, covariance, start, floor_start() if start_covariance is None else start_covariance)

    @property
    def warnings(self) -> list[str]:
        """What whoever reads the results must know: one sentence each."""
        alone = [self.covariance[k : k + 3, k : k + 3] for k in range(0, 3 * len(self.planes), 3)]
        if len(alone) == 1 or not np.array_equal(self.covariance, block_diag(*alone)):
            return []
        return [
            f"the {len(self.planes)} planes of the prior map are taken as independent, for it does not tell what they "
            "share (the drift of its mission): standard deviations come out too small; give the run's folder instead"
        ]

    def plant(self, landmarks: LandmarkMap, backend: Backend) -> None:
        """Put the planes into an empty graph and an empty map as landmarks, with their joint prior."""
        values, keys = gtsam.Values(), [gtsam.symbol("p", known.id) for known in self.planes]
        values.insert(MAP_KEY, gtsam.Pose3())
        for key, one in zip(keys, self.planes, strict=True):
            plane, known = one.plane, max(one.observations, 2)
            values.insert(key, plane_landmark(plane))
            landmarks.plant(Landmark(one.id, key, MAP_KEY, plane.frame, one.seen, n_points=plane.n_points, known=known))
        factors = [
            pose_prior(MAP_KEY, np.eye(4), 1e-6**2 * np.eye(6)),  # the map's own frame is where it is
            map_prior([known.plane for known in self.planes], keys, self.covariance),
        ]
        backend.update(factors, values)
        landmarks.refresh(backend)

    def to_bytes(self) -> bytes:
        """For a session."""
        return encode({**vars(self), "planes": list(self.planes)})

    @classmethod
    def from_bytes(cls, data: bytes) -> PriorMap:
        """Inverse of `to_bytes`; a ValueError where it is not that."""
        content = decode(data)
        try:
            return cls(**content)
        except TypeError as error:
            raise CodecError(f"expected a prior map, got something else ({error})") from error


def floor_start(sigma_m: float = START_SIGMA_M, sigma_rad: float = START_SIGMA_RAD) -> FloatArray:
    """Covariance (6, 6) of the start of a robot on the floor whose place is known to ``sigma_m`` and ``sigma_rad``."""
    off_floor_m, tilt_rad = 1e-3, 1e-3
    return np.diag(np.square((sigma_m, sigma_m, off_floor_m, sigma_rad, tilt_rad, tilt_rad)))


def finished_map(planes: Sequence[MapPlane], landmarks: LandmarkMap, backend: Backend) -> bytes:
    """The map of a run with the joint covariance of its planes, for a session to keep."""
    return encode({"planes": list(planes), "covariance": map_covariance(planes, landmarks, backend)})


def map_covariance(planes: Sequence[MapPlane], landmarks: LandmarkMap, backend: Backend) -> FloatArray:
    """Joint covariance of the (z, theta, psi) of map planes in their frames, stacked, shape (3 N, 3 N)."""
    owners = [landmarks[known.id] for known in planes]
    if not owners:
        return np.empty((0, 0))
    keys = sorted({key for owner in owners for key in (owner.anchor_key, owner.key)})
    joint = backend.read_joint_covariance(keys)
    jacobian = np.zeros((3 * len(owners), len(joint.full)))
    for row, (known, one) in enumerate(zip(planes, owners, strict=True)):
        columns = joint.columns([one.anchor_key, one.key])
        block = anchored_plane_jacobian(backend.plane(one.key), backend.pose(one.anchor_key), known.plane.frame)
        jacobian[3 * row : 3 * row + 3, columns] = block
    return jacobian @ joint.full @ jacobian.T


def _of_run(path: Path) -> tuple[list[MapPlane], FloatArray]:
    with Session.open(path, read_only=True) as session:
        data = session.result("map")
    if data is None:
        raise SessionError(f"{path}: expected a finished run, got one that has no map yet")
    content = decode(data)
    if not isinstance(content, dict) or content.keys() != {"planes", "covariance"}:
        raise SessionError(f"{path}: expected the map of a finished run, got something else")
    return content["planes"], content["covariance"]


def _independent(path: Path) -> tuple[list[MapPlane], FloatArray]:
    entries = [
        MapPlane(number, plane, plane.outline, 2, ("plane",))
        for number, plane in enumerate(read_planes(path))
        if plane.outline is not None
    ]
    return entries, np.asarray(block_diag(*(entry.plane.covariance for entry in entries)))


def read_prior(path: Path, start: str, sigma: str, first: Callable[[], Keyframe]) -> PriorMap:
    """The prior map, and the start as words, m and deg: X,Y,HEADING on the floor, or X,Y,Z,YAW,PITCH,ROLL; its sigmas.

    `first` gives the first keyframe of the mission, where its start is to be found by what it sees.
    """
    numbers = _numbers("--start", "0,0,0" if start == FIND else start, 3, 6)
    sigma_m, sigma_deg = _numbers("--start-sigma", sigma, 2)
    if min(sigma_m, sigma_deg) <= 0.0:
        raise ValueError(f"--start-sigma: expected two positive numbers, got {sigma!r}")
    sigmas = sigma_m, float(np.deg2rad(sigma_deg))
    x, y, z, *turns = numbers if len(numbers) == 6 else (*numbers[:2], 0.0, numbers[2], 0.0, 0.0)
    world_T_start = transform_from_rpy((x, y, z, *np.deg2rad(turns).tolist()))
    prior = PriorMap.load(path, world_T_start=world_T_start, start_covariance=floor_start(*sigmas))
    if start == FIND:
        prior = replace(prior, world_T_start=find_start(prior.planes, first()))
    pose = prior.world_T_start
    if pose[2, 3] == 0.0 and pose[2, 2] == 1.0:
        return prior
    return replace(prior, start_covariance=np.diag(np.square(np.repeat(sigmas, 3))))  # off any floor


def _numbers(name: str, text: str, *counts: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        wanted = " or ".join(map(str, counts))
        raise ValueError(f"{name}: expected {wanted} numbers with commas between them, got {text!r}")
    return numbers
