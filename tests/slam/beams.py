"""What the beams of simulated scans read, against the planes that they hit."""

from typing import NamedTuple

import numpy as np

from benchmarks.corpus.drives import Drive
from slam.sensors.log import LaserScan
from slam.simulation import Mission


class BeamErrors(NamedTuple):
    """All beams of one sensor that hit a plane, N of them."""

    range_m: np.ndarray  # ranges read less those at which the beams meet their planes, (N,)
    points: np.ndarray  # what was read, in the sensor's axes, (N, 3)
    rays: np.ndarray  # their directions there, (N, 3)
    cosine: np.ndarray  # of the angles between the beams and the normals against them, (N,)
    labels: np.ndarray  # the planes' numbers, (N,)


def beam_errors(mission: Mission | Drive, sensor: str) -> BeamErrors:
    """Of all scans of the sensor, every one taken at a single pose."""
    normals = np.array([plane.normal for plane in mission.truth.planes])
    offsets, found = np.array([plane.d for plane in mission.truth.planes]), []
    for scan, labels in zip(mission.log.scans(sensor), mission.truth.labels[sensor], strict=True):
        if isinstance(scan, LaserScan):
            beams = np.column_stack([np.cos(scan.angles), np.sin(scan.angles), 0.0 * scan.angles])
            points = scan.ranges[:, None] * beams
        else:
            points = scan.points.reshape(-1, 3)
        seen = labels.ravel() >= 0
        points, labels = points[seen], labels.ravel()[seen]
        pose = mission.truth.poses_at(np.array([scan.stamp_ns]))[0] @ mission.rig.sensors[sensor].body_T_sensor
        ranges = np.linalg.norm(points, axis=1)
        rays = points / ranges[:, None]
        slope = np.einsum("ni,ni->n", normals[labels], rays @ pose[:3, :3].T)
        errors = ranges - (offsets[labels] - normals[labels] @ pose[:3, 3]) / slope
        found.append((errors, points, rays, -slope, labels))
    return BeamErrors(*map(np.concatenate, zip(*found, strict=True)))
