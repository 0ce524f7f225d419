"""A run's graph back from another tool: the edited g2o file's solution as the planes and the trajectory of the run."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

from factors import anchored_plane_jacobian, joint_covariance, landmark_hesse
from slam.errors import LogError
from slam.evaluation import Metric
from slam.geometry.frames import settle_frame
from slam.io.g2o.reader import G2oGraph, read_g2o
from slam.io.g2o.writer import with_vertices
from slam.io.trajectories import Trajectory
from slam.map.map_planes import MapPlane
from slam.runs.stored_run import StoredRun
from spplanes import Plane
from spplanes._check import FloatArray

_SIGHTING = "EDGE_SE3_PLANE_CALIB"
#: Two spellings of one pose or one plane differ by less: numbers of a file are exact, products of rotations are not.
_SAME = 1e-6
#: Of what two graphs measure between the same vertices this share has to be the same for both to be of one run ...
_OF_ONE_RUN = 0.5
#: ... up to what other tools round to, of numbers around 1; two looks at one plane are hardly ever as near.
_ROUNDED = 1e-5


@dataclass(frozen=True, eq=False)
class ImportedRun:
    """What a run looks like after its graph was edited or solved elsewhere."""

    planes: list[MapPlane]
    """Those of the run that the graph still has, in its world, with the graph's own covariances."""
    trajectory: Trajectory
    """All poses of the run; those that the graph does not have stay where they were relative to the nearest in time."""
    odometry: Trajectory
    graph: str
    """Text of the g2o file, its vertices at the solution."""
    table: list[Metric]


def import_graph(path: Path | str, run: Path | str, *, solve: bool = True) -> ImportedRun:
    """Read a g2o file that began as the graph.g2o of ``run``, with the same vertex ids, solved or as it is.

    A plane's outline and points are the run's: it goes where the nearest pose that sees it went, and from there by the
    shortest way onto the plane of its vertex. Covariances are the marginals of the graph in the file.

    Raises:
        LogError: a file that is missing or broken, that shares no pose with the run's graph or has the measurements of
            another run, or whose graph leaves poses or planes open.
    """
    path, stored = Path(path), StoredRun.read(run)
    before, after = read_g2o(stored.graph_file), read_g2o(path)
    shared = sorted(before.poses.keys() & after.poses.keys())
    if not shared:
        raise LogError(path, f"expected poses with the vertex ids of {stored.graph_file}, found none")
    _check_origin(before, after, path, run)
    values, marginals = _solution(after, path, solve=solve)
    moved = _Moved(before, values, shared)
    numbers, observers = _vertices_of(stored.planes, before), defaultdict(set)
    for edge in after.edges:
        if edge.kind == _SIGHTING:
            observers[edge.ids[1]].add(edge.ids[0])
    planes = []
    for known in stored.planes:
        if (number := numbers.get(known.id)) in after.planes:
            key = after.planes[number]
            motion = moved.beside(known.plane.centre, observers[number])
            plane = _placed(known.plane, motion, values.atOrientedPlane3(key), marginals, key)
            planes.append(replace(known, plane=plane))
    trajectory = moved.trajectory(stored.trajectory)
    table = _changes(stored, planes, trajectory, after, values)
    return ImportedRun(planes, trajectory, stored.odometry, with_vertices(path, after, values), table)


class _Moved:
    """How far each pose of a graph went, new_T_old in the world."""

    def __init__(self, before: G2oGraph, values: gtsam.Values, shared: list[int]) -> None:
        self._old = np.array([before.values.atPose3(before.poses[number]).matrix() for number in shared])
        new = np.array([values.atPose3(before.poses[number]).matrix() for number in shared])
        self._motions = new @ np.linalg.inv(self._old)
        self._rows = {number: row for row, number in enumerate(shared)}

    def beside(self, place: FloatArray, numbers: set[int]) -> FloatArray:
        """Motion (4, 4) of the pose nearest to a place (3,), out of these vertices if any of them is known."""
        rows = sorted(self._rows[one] for one in numbers & self._rows.keys()) or list(range(len(self._old)))
        distances = np.linalg.norm(self._old[rows, :3, 3] - place, axis=1)
        return self._motions[rows[int(np.argmin(distances))]]

    def trajectory(self, run: Trajectory) -> Trajectory:
        """Every pose moved as the pose of the graph that is nearest in time."""
        gaps = np.abs(run.poses[:, None] - self._old[None]).max(axis=(2, 3))
        owners = np.where(gaps.min(axis=1) < _SAME, gaps.argmin(axis=1), -1)
        known = np.flatnonzero(owners >= 0)
        if not len(known):
            return run
        waits = np.abs(run.stamps_ns[:, None] - run.stamps_ns[known][None])
        return Trajectory(run.stamps_ns, self._motions[owners[known[waits.argmin(axis=1)]]] @ run.poses)


def _check_origin(before: G2oGraph, after: G2oGraph, path: Path, run: Path | str) -> None:
    """Refuse the graph of another run: vertex ids count up in all of them, but what was measured is a run's own.

    Edges may have gone, come, or been given other numbers, yet most that are left between the same vertices measure
    what they did. Planes are asked first: runs of one log share their odometry.
    """
    for kind in (_SIGHTING, "EDGE_SE3:QUAT"):
        known: dict[tuple[int, ...], list[FloatArray]] = defaultdict(list)
        for edge in before.edges:
            if edge.kind == kind:
                known[edge.ids].append(edge.measured)
        edges = [edge for edge in after.edges if edge.kind == kind]
        if not edges or not known:
            continue
        beside = [edge for edge in edges if edge.ids in known]
        same = sum(any(_is_rounded(edge.measured, one) for one in known[edge.ids]) for edge in beside)
        if not beside or same < _OF_ONE_RUN * len(beside):
            found = f"{same} of {len(edges)} edges {kind} measure what they do there"
            raise LogError(path, f"expected the graph of {run}, got that of another run: {found}")
        return


def _is_rounded(one: FloatArray, other: FloatArray) -> bool:
    """Whether two measurements are the same, as text of fewer digits; the sign of a quaternion or a plane is free."""
    room = _ROUNDED * (1.0 + np.abs(other))
    turned = np.append(one[:3], -one[3:]) if len(one) == 7 else -one
    return bool((np.abs(one - other) <= room).all() or (np.abs(turned - other) <= room).all())


def _solution(graph: G2oGraph, path: Path, *, solve: bool) -> tuple[gtsam.Values, gtsam.Marginals]:
    try:
        values = graph.values
        if solve:
            values = gtsam.LevenbergMarquardtOptimizer(graph.graph, values).optimize()
        return values, gtsam.Marginals(graph.graph, values)
    except RuntimeError as error:
        sentence = "expected a graph that holds every pose and plane, got one that leaves some open"
        raise LogError(path, f"{sentence} ({str(error).strip().splitlines()[0]})") from error


def _vertices_of(planes: list[MapPlane], graph: G2oGraph) -> dict[int, int]:
    """Vertex id of each plane of the run, by landmark id: the one with the same coefficients."""
    numbers = list(graph.planes)
    if not numbers:
        return {}
    rows = np.array([graph.values.atOrientedPlane3(graph.planes[number]).planeCoefficients() for number in numbers])
    found = {}
    for known in planes:
        gaps = np.abs(rows - np.array([*known.plane.normal, -known.plane.d])).max(axis=1)
        if gaps.min() < _SAME:
            found[known.id] = numbers[int(gaps.argmin())]
    return found


def _placed(
    plane: Plane, motion: FloatArray, landmark: gtsam.OrientedPlane3, marginals: gtsam.Marginals, key: int
) -> Plane:
    """The plane moved, then turned and shifted by the shortest way onto the landmark, with its marginal covariance."""
    frame = motion @ plane.frame
    normal, d = landmark_hesse(landmark)
    if normal @ frame[:3, 2] < 0.0:  # turned round by the other tool: the same plane
        normal, d = -normal, -d
    frame = settle_frame(frame, normal, d)
    jacobian = anchored_plane_jacobian(landmark, np.eye(4), frame)[:, 6:]
    covariance = jacobian @ joint_covariance(marginals, [key]) @ jacobian.T
    return Plane(frame, 0.5 * (covariance + covariance.T), plane.n_points, plane.outline)


def _changes(
    run: StoredRun, planes: list[MapPlane], trajectory: Trajectory, graph: G2oGraph, values: gtsam.Values
) -> list[Metric]:
    steps = np.linalg.norm(trajectory.poses[:, :3, 3] - run.trajectory.poses[:, :3, 3], axis=1)
    return [
        Metric("poses in the graph", len(graph.poses), ""),
        Metric("planes taken over", len(planes), ""),
        Metric("planes of the run that the graph has no more", len(run.planes) - len(planes), ""),
        Metric("planes of the graph without an outline, left out", len(graph.planes) - len(planes), ""),
        Metric("largest shift of a pose", float(steps.max(initial=0.0)), "m"),
        Metric("chi2 of the file as it is", 2.0 * graph.graph.error(graph.values), ""),
        Metric("chi2 of what was taken", 2.0 * graph.graph.error(values), ""),
    ]
