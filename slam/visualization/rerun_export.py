"""A run as a Rerun recording: planes, both trajectories, poses and NIS on one timeline."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from slam.errors import optional
from slam.map.map_planes import MapPlane
from slam.runs.stored_run import StoredRun
from slam.visualization.mesh import chains_of, colour_of, mesh_of
from slam.visualization.pictures import CONFIDENCE, position_covariances


def write_rerun(run: StoredRun, path: Path | str) -> None:
    """Write a run as a .rrd file for the Rerun viewer.

    Entities: ``map/plane_ID`` (a mesh with its outline, the numbers as text), ``trajectory``, ``odometry``, ``body``
    (the pose of every keyframe), ``confidence`` (ellipsoids of 95 % at the positions), ``nis/TYPE`` (chi2 per degree of
    freedom, mean of the keyframe). Timelines: keyframe, stamp. ImportError: the Rerun SDK is not there.
    """
    rr = optional("rerun")
    recording = rr.RecordingStream("spplanes", recording_id=run.folder.resolve().name or "run")

    def set_time(keyframe: int) -> None:
        recording.set_time("keyframe", sequence=keyframe)
        if keyframe < len(run.trajectory):
            recording.set_time("stamp", duration=np.timedelta64(int(run.trajectory.stamps_ns[keyframe]), "ns"))

    recording.save(str(path))
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for plane in run.planes:
        _log_plane(rr, recording, plane)
    black, red = (20, 20, 20), (197, 48, 48)
    for name, trajectory, colour in (("trajectory", run.trajectory, black), ("odometry", run.odometry, red)):
        if len(trajectory):
            strip = rr.LineStrips3D([trajectory.poses[:, :3, 3]], colors=[colour])
            recording.log(name, strip, static=True)
    _log_confidence(rr, recording, run)
    for keyframe, pose in enumerate(run.trajectory.poses):
        set_time(keyframe)
        recording.log("body", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    for kind, rows in sorted(run.history.nis.items()):
        for keyframe, group in groupby(sorted(rows), key=lambda row: row[0]):
            mine = list(group)
            set_time(keyframe)
            mean = sum(row[1] for row in mine) / sum(row[2] for row in mine)
            recording.log(["nis", kind], rr.Scalars([mean]))
    recording.flush()
    recording.disconnect()


def _log_plane(rr: Any, recording: Any, plane: MapPlane) -> None:
    entity, colour = f"map/plane_{plane.id}", colour_of(plane)
    mesh = mesh_of([plane])
    if len(mesh.triangles):
        looks = {"vertex_normals": mesh.normals, "vertex_colors": mesh.colours}
        shape = rr.Mesh3D(vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, **looks)
        recording.log(entity, shape, static=True)
    if chains := chains_of(plane):
        recording.log(f"{entity}/outline", rr.LineStrips3D(chains, colors=[colour] * len(chains)), static=True)
    sigmas = np.sqrt(np.diag(plane.plane.covariance))
    numbers = (
        f"normal {np.round(plane.plane.normal, 5).tolist()}, d {plane.plane.d:.5f} m, "
        f"sigma z {1e3 * sigmas[0]:.3g} mm, tilts {np.rad2deg(sigmas[1]):.2g}, {np.rad2deg(sigmas[2]):.2g} deg, "
        f"{plane.plane.n_points} points, {plane.observations} keyframes"
    )
    recording.log(f"{entity}/numbers", rr.TextDocument(numbers), static=True)


def _log_confidence(rr: Any, recording: Any, run: StoredRun) -> None:
    places, covariances = position_covariances(run, run.history)
    if not len(places):
        return
    values, vectors = np.linalg.eigh(covariances)
    vectors[np.linalg.det(vectors) < 0.0, :, 0] *= -1.0
    half = np.sqrt(np.maximum(values, 0.0) * 2.0 * gammaincinv(0.5 * 3, CONFIDENCE))
    turns = [rr.Quaternion(xyzw=Rotation.from_matrix(axes).as_quat()) for axes in vectors]
    blue = [(43, 108, 176)] * len(places)
    ellipsoids = rr.Ellipsoids3D(centers=places, half_sizes=half, quaternions=turns, colors=blue)
    recording.log("confidence", ellipsoids, static=True)
