"""What is wrong with a drive beside its odometry: a mount, stated noise, scans left out, time reversed, a prior map."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.corpus.polygon_world import PolygonWorld
from slam.geometry.frames import planar_transform
from slam.io.scan_files import in_order
from slam.map.map_planes import MapPlane
from slam.sensors.log import Event, Log, OdometryReading
from slam.sensors.rig import Mount, Rig, Sensor
from slam.session.prior_map import PriorMap, floor_start
from slam.simulation.record import Truth
from spplanes._check import FloatArray
from spplanes.plane import Plane

if TYPE_CHECKING:
    from benchmarks.corpus.drives.drive import Recipe

#: How well a prior map knows its planes: their distance, m, and tilt, rad.
_KNOWN_M, _KNOWN_RAD = 0.005, 0.002
#: Planes smaller than this are in no prior map, m^2.
_LARGE_M2 = 0.5
#: A wrong start: so far from the true one, m and rad.
_AWAY_M, _TURNED_RAD = 2.0, 0.5


@dataclass(frozen=True, eq=False)
class Drive:
    """A recorded drive, what its user says of it, and the truth."""

    recipe: Recipe
    level: bool  # whether the robot stays on one floor
    log: Log
    rig: Rig  # what the user says of the robot; not always true
    truth: Truth  # true poses at every scan and reading, planes and labels
    prior: PriorMap | None = None  # a map from before, in the frame of the truth, unless it is of another building
    world: PolygonWorld | None = None  # the building; None: nobody needs it
    elsewhere: PolygonWorld | None = None  # another building


Disturbance = Callable[[Drive, np.random.Generator], Drive]


def none(given: Drive, rng: np.random.Generator) -> Drive:
    return given


def with_sensors(given: Drive, change: Callable[[Sensor], dict[str, Any]]) -> Drive:
    """The drive with a rig that says something else of each sensor."""
    sensors = {name: one.model_copy(update=change(one)) for name, one in given.rig.sensors.items()}
    return replace(given, rig=given.rig.model_copy(update={"sensors": sensors}))


def backwards(given: Drive, rng: np.random.Generator) -> Drive:
    """The rig has every sensor the wrong way round: turned by half a turn about the body's z."""

    def turned(sensor: Sensor) -> dict[str, Any]:
        matrix = planar_transform(0.0, 0.0, np.pi) @ sensor.body_T_sensor
        matrix[:3, 3] = sensor.body_T_sensor[:3, 3]
        return {"mount": Mount.of(matrix)}

    return with_sensors(given, turned)


def stated(factor: float) -> Disturbance:
    """The rig states so many times the noise that the ranges have."""

    def state(given: Drive, rng: np.random.Generator) -> Drive:
        return with_sensors(given, lambda sensor: {"range_sigma_m": factor * sensor.range_sigma_m})

    return state


def every(nth: int) -> Disturbance:
    """Only every so many-th scan of each sensor; all of the odometry."""

    def keep(given: Drive, rng: np.random.Generator) -> Drive:
        labels = {name: rows[::nth] for name, rows in given.truth.labels.items()}
        return replace(given, log=thinned(given.log, nth), truth=replace(given.truth, labels=labels))

    return keep


def thinned(log: Log, nth: int, first: int = 0) -> Log:
    """The log with every so many-th scan of each sensor, from its first or a later one on; all of the odometry."""
    counts: dict[str, Iterator[int]] = defaultdict(itertools.count)

    def stays(event: Event) -> bool:
        return isinstance(event, OdometryReading) or (next(counts[event.sensor]) - first) % nth == 0

    return replace(log, events=list(filter(stays, log.events)))


def backward_in_time(given: Drive, rng: np.random.Generator) -> Drive:
    """The drive from its end to its beginning."""
    ends = int(given.truth.stamps_ns[0]) + int(given.truth.stamps_ns[-1])
    events = in_order(replace(event, stamp_ns=ends - event.stamp_ns) for event in reversed(given.log.events))
    truth = replace(
        given.truth,
        stamps_ns=ends - given.truth.stamps_ns[::-1],
        world_T_body=given.truth.world_T_body[::-1],
        labels={name: rows[::-1] for name, rows in given.truth.labels.items()},
    )
    return replace(given, log=replace(given.log, events=events), truth=truth)


def prior(given: Drive, rng: np.random.Generator) -> Drive:
    """A map of this building and about where the drive begins in it."""
    start = _first_pose(given) @ planar_transform(*rng.standard_normal(3) * (0.1, 0.1, 0.03))
    return replace(given, prior=_map_of(given.world, start, rng))


def prior_start(given: Drive, rng: np.random.Generator) -> Drive:
    """A map of this building, and a start metres from the true one that is stated to 0.3 m."""
    direction = rng.uniform(0.0, 2.0 * np.pi)
    away = (_AWAY_M * np.cos(direction), _AWAY_M * np.sin(direction), rng.choice([-1.0, 1.0]) * _TURNED_RAD)
    return replace(given, prior=_map_of(given.world, _first_pose(given) @ planar_transform(*away), rng))


def prior_elsewhere(given: Drive, rng: np.random.Generator) -> Drive:
    """A map of another building."""
    return replace(given, prior=_map_of(given.elsewhere, _first_pose(given), rng))


#: Kinds of disturbance.
DISTURBANCES: dict[str, Disturbance] = {
    "none": none,
    "backwards": backwards,
    "noise0.3": stated(0.3),
    "noise3": stated(3.0),
    "half": every(2),
    "fifth": every(5),
    "reversed": backward_in_time,
    "prior": prior,
    "prior_start": prior_start,
    "prior_elsewhere": prior_elsewhere,
}


def _first_pose(given: Drive) -> FloatArray:
    """True pose at the first scan, shape (4, 4)."""
    return given.truth.poses_at(np.array([given.log.scans()[0].stamp_ns]))[0]


def _map_of(world: PolygonWorld | None, start: FloatArray, rng: np.random.Generator) -> PriorMap:
    """The larger planes of a building as a map that errs as it says, each by itself, with all that is of them."""
    assert world is not None  # whoever makes the drive gives it
    sigmas = np.array([_KNOWN_M, _KNOWN_RAD, _KNOWN_RAD])
    both = zip(world.planes, world.seen, strict=True)
    large = [(plane, seen) for plane, seen in both if plane.outline is not None and plane.outline.area >= _LARGE_M2]
    known = []
    for number, (plane, seen) in enumerate(large):
        known.append(MapPlane(number, _moved(plane, sigmas * rng.standard_normal(3), sigmas), seen, 3, ("plane",)))
    return PriorMap(known, np.diag(np.tile(sigmas**2, len(known))), start, floor_start())


def _moved(plane: Plane, error: FloatArray, sigmas: FloatArray) -> Plane:
    """A plane off by (z, theta, psi) in its own frame, with the covariance of that."""
    z, theta, psi = error
    turn = Mount(rpy_deg=(float(np.rad2deg(psi)), float(np.rad2deg(theta)), 0.0)).as_matrix()
    turn[2, 3] = z
    return replace(plane, frame=plane.frame @ turn, covariance=np.diag(sigmas**2), n_points=1000)
