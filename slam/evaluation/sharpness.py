"""How sharp a map is: how thin surfaces are that several scans saw, by two sets of poses of the same scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.evaluation.trajectories import Metric, common_poses
from slam.frontend.measurement import returns_of
from slam.geometry.frames import lift
from slam.io.load import load
from slam.io.trajectories import Trajectory, read_tum
from slam.sensors.log import CloudScan
from slam.session.opening import session_path
from slam.session.store import Session
from slam.tracking.turns import sweeps_of
from spplanes._check import FloatArray

#: Side of the cubes that points are gathered in, m.
_CELL_M = 1.0
#: Cells of fewer points, or of points of fewer scans, say nothing.
_MIN_POINTS, _MIN_SCANS = 30, 3
#: A cell holds one plane where its thickness is at most this share of its smaller width (standard deviations).
_FLAT = 0.2
#: A plane this near to the face of a cube, in thicknesses, may be cut in two along itself, and seem thinner.
_CUT = 4.0


@dataclass(frozen=True)
class Sharpness:
    """Median distances of the same points from planes that scans share, by two sets of poses; NaN: none is shared."""

    estimate_m: float
    reference_m: float
    cells: int
    """Pieces of planes that were looked at."""

    def metrics(self) -> list[Metric]:
        """The rows of a table."""
        return [
            Metric("sharpness, median point to plane", self.estimate_m, "m"),
            Metric("sharpness by the reference", self.reference_m, "m"),
            Metric("sharpness, pieces of planes", self.cells, ""),
        ]


def compare_sharpness(clouds: Sequence[FloatArray], poses: FloatArray, reference: FloatArray) -> Sharpness:
    """Compare two sets of poses of the same scans by how thin they make the planes that at least three scans see.

    The points are put where `poses` has them and gathered in cubes. A cube whose points, of all scans together, lie
    about one plane by the one set of poses and by the other is one both see; of its points the distances from the
    plane through them are taken, by either set with a plane of its own.

    Args:
        clouds: points of each scan in the body's frame, shape (N, 3) or (S, B, 3), m; NaN = no return.
        poses, reference: world_T_body of each scan, in two worlds, shape (K, 4, 4); ValueError: not one a cloud.
    """
    if not len(clouds) == len(poses) == len(reference):
        raise ValueError(f"poses: expected {len(clouds)}, one a cloud, got {len(poses)} and {len(reference)}")
    used = [flat[np.isfinite(flat).all(axis=1)] for flat in (np.reshape(cloud, (-1, 3)) for cloud in clouds)]
    scan = np.repeat(np.arange(len(used)), [len(cloud) for cloud in used])
    mine, theirs = (np.concatenate(list(map(lift, used, where))) for where in (poses, reference))
    cell = np.unique(np.floor(mine / _CELL_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    pairs = np.unique(np.stack((cell, scan), axis=1), axis=0)
    shared = (np.bincount(pairs[:, 0]) >= _MIN_SCANS) & (np.bincount(cell) >= _MIN_POINTS)
    mine, theirs, cell = mine[shared[cell]], theirs[shared[cell]], cell[shared[cell]]
    cell = np.unique(cell, return_inverse=True)[1].ravel()
    (here, flat, are_cut), (there, flat_there, _) = _pieces(mine, cell), _pieces(theirs, cell)
    both = flat & flat_there & ~are_cut
    if not both.any():
        return Sharpness(np.nan, np.nan, 0)
    ours, others = (float(np.median(distances[both[cell]])) for distances in (here, there))
    return Sharpness(ours, others, int(both.sum()))


def _pieces(points: FloatArray, cell: np.ndarray) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """By points (N, 3) and the cell (N,) of each: the distance of each from the plane through the points of its cell.

    Then which cells (C,) hold a plane, and of which it lies along a face of their cube.
    """
    counts = np.bincount(cell)
    centres = np.stack([np.bincount(cell, column) for column in points.T], axis=1) / counts[:, None]
    away = points - centres[cell]
    scatter = np.empty((len(counts), 3, 3))
    for i, j in np.ndindex(3, 3):
        scatter[:, i, j] = np.bincount(cell, away[:, i] * away[:, j]) / counts
    values, vectors = np.linalg.eigh(scatter)
    normals, widths = vectors[:, :, 0], np.sqrt(np.maximum(values, 0.0))
    axis = np.abs(normals).argmax(axis=1)
    place = np.take_along_axis(centres, axis[:, None], axis=1)[:, 0] / _CELL_M
    are_cut = np.abs(place - np.rint(place)) * _CELL_M < _CUT * widths[:, 0]
    return np.abs(np.einsum("ni,ni->n", away, normals[cell])), widths[:, 0] <= _FLAT * widths[:, 1], are_cut


#: So many points of all scans together are enough, evenly taken.
_ENOUGH = 600_000


def sharpness_of_run(run: Path, reference: Trajectory, log: Path) -> list[Metric]:
    """Median distance of points from the planes that scans share, by trajectory.tum of a run and by a reference.

    The 3D scans of the log that the run was made from are read again, with the rig of its session. LogError: they
    cannot be, or there are none at the times of the poses; ValueError: run and reference have no times in common.
    """
    stamps, poses, others = common_poses(read_tum(run / "trajectory.tum"), reference)
    rig = None  # of a run that kept no session that of the log
    if session_path(run).is_file():
        with Session.open(run, read_only=True) as session:
            rig = session.rig
    source, rig = load(log, rig)
    scans = {scan.stamp_ns: scan for scan in source.scans() if isinstance(scan, CloudScan)}
    found = [k for k, stamp in enumerate(stamps.tolist()) if stamp in scans]
    if not found:
        raise LogError(log, "expected 3D scans at the times of the run's poses, found none")
    sensed = [(scans[stamps[k]], rig.sensors[scans[stamps[k]].sensor]) for k in found]
    sweeps = sweeps_of(Trajectory(stamps[found], poses[found]), (sensor for _, sensor in sensed))
    clouds = [lift(returns_of(scan, sensor, sweeps), sensor.body_T_sensor) for scan, sensor in sensed]
    every = max(sum(map(len, clouds)) // _ENOUGH, 1)
    return compare_sharpness([cloud[::every] for cloud in clouds], poses[found], others[found]).metrics()
