"""Initial pose: where in a known map a mission starts, by what its first keyframe sees; or that it cannot be told.

Two walls that are not parallel, each taken for one of the map, make a pose on the floor. Every such pose is a
hypothesis; it explains those lengths of the walls seen that lie along walls of the map. The best must explain most of
what was seen, and far more than any other place does: a room of two equal halves has no start that can be told.

Planes seen in three directions tell the pose off the floor too: at another height, or of a scanner that is tipped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from factors.association.observations import planes_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import are_apart, lift, planar_transform
from slam.geometry.polygons import polygonal
from slam.map.map_planes import MapPlane
from slam.registration.plane_registration import places_anywhere
from spplanes import Plane
from spplanes._check import FloatArray

#: Walls are upright to this, and one wall in two views to that, rad and m.
_UPRIGHT, _TURN_RAD, _SHIFT_M = 0.1, np.deg2rad(3.0), 0.15
#: Shorter ones say too little, m.
_LEAST_M = 0.5
#: Share of the lengths seen that the best place explains at least; another place explains at most this share of it.
_ENOUGH, _CLEAR = 0.6, 0.85
#: Planes are level when their normals are nearer to upright than this, cosine of 20 deg.
_LEVEL = 0.94
#: Places nearer to each other than this are one, m and rad.
_SAME_M, _SAME_RAD = 0.5, np.deg2rad(10.0)


def find_start(planes: Sequence[MapPlane], keyframe: Keyframe) -> FloatArray:
    """world_T_body (4, 4) of a keyframe in a map: on its floor, where that explains the floors and ceilings seen.

    Raises:
        ValueError: no two walls were seen, no place explains enough of what was seen, or several do.
    """
    seen, known = planes_of(keyframe.observations), [one.plane for one in planes]
    spread = np.linalg.svd(np.array([plane.normal for plane in seen]).reshape(-1, 3), compute_uv=False)
    in_space = len(spread) == 3 and spread[2] > 0.2 * spread[0]
    try:
        start = _on_the_floor(planes, keyframe)
    except _SeveralPlacesError as error:
        if not in_space or _levels_fit(known, seen, error.best):
            raise
    except ValueError:
        if not in_space:
            raise
    else:
        if not in_space or _levels_fit(known, seen, start):
            return start
    return _in_space(planes, seen)


class _SeveralPlacesError(ValueError):
    """Several places explain a keyframe about as well."""

    def __init__(self, sentence: str, best: FloatArray) -> None:
        super().__init__(sentence)
        self.best = best


def _in_space(planes: Sequence[MapPlane], seen: Sequence[Plane]) -> FloatArray:
    """The place in all six directions by planes seen in three."""
    known = [
        plane.plane if plane.plane.outline is not None else replace(plane.plane, outline=polygonal(plane.seen))
        for plane in planes
    ]
    # what carries a scanner is tipped, not upside down: a scanner that hangs has a mount that says so
    places = [one for one in places_anywhere(seen, known) if one[1].known_T_seen[2, 2] > 0.0]
    shares, poses = np.array([share for share, _ in places]), [one.known_T_seen for _, one in places]
    return _one_place(shares, poses, "planes", "X,Y,HEADING or X,Y,Z,YAW,PITCH,ROLL", _told_in_space)


def _one_place(
    shares: FloatArray, poses: Sequence[FloatArray], what: str, wanted: str, told: Callable[[FloatArray], str]
) -> FloatArray:
    """The pose (4, 4) that explains the most, if its share (N,) is enough, and far more than any other place does.

    Told to a user are what was seen, the start that is wanted of him instead, and poses as he would tell them.
    """
    if shares.max(initial=0.0) < _ENOUGH:
        raise ValueError(
            f"--start: expected a place in the map that explains {100 * _ENOUGH:.0f} % of the {what} in the first "
            f"keyframe, found {100 * shares.max(initial=0.0):.0f} %; give {wanted}"
        )
    best, *others = np.argsort(-shares, kind="stable").tolist()
    for other in others:
        if shares[other] > _CLEAR * shares[best] and are_apart(poses[best], poses[other], _SAME_M, _SAME_RAD):
            raise _SeveralPlacesError(
                "--start: expected one place in the map that explains the first keyframe, found "
                f"{told(poses[best])} and {told(poses[other])}; give {wanted}",
                poses[best],
            )
    return poses[best]


def _levels_fit(known: Sequence[Plane], seen: Sequence[Plane], start: FloatArray) -> bool:
    """Whether a floor or ceiling seen is one of the map from there; true where none is seen or none is known."""
    mine = [plane.transform(start) for plane in seen]
    mine = [plane for plane in mine if abs(plane.normal[2]) > _LEVEL]
    theirs = [plane for plane in known if abs(plane.normal[2]) > _LEVEL]
    alike = [
        one.normal @ other.normal > np.cos(_TURN_RAD) and abs(other.normal @ one.centre - other.d) < _SHIFT_M
        for one in mine
        for other in theirs
    ]
    return any(alike) or not alike


def _on_the_floor(planes: Sequence[MapPlane], keyframe: Keyframe) -> FloatArray:
    """The place on the floor by walls."""
    known = _walls([_ends_of(plane) for plane in planes])
    seen = _walls([(observation.normal, observation.vertices) for observation in keyframe.observations])
    seen = seen[np.argsort(seen[:, 2] - seen[:, 3], kind="stable")][:12]
    poses = _hypotheses(known, seen)
    if not len(poses):
        raise ValueError("--start: expected two walls of the map in the first keyframe, found none; give X,Y,HEADING")
    shares = np.array([_explained(known, seen, pose) for pose in poses])
    return _one_place(shares, [planar_transform(*pose) for pose in poses.tolist()], "walls", "X,Y,HEADING", _told)


def _ends_of(one: MapPlane) -> tuple[FloatArray, FloatArray]:
    shape = one.plane.outline if one.seen.is_empty and one.plane.outline is not None else one.seen
    return one.plane.normal, lift(shapely.get_coordinates(shape), one.plane.frame)


def _walls(found: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Rows (direction of the normal, rad; d, first and last place along the wall, m) of the upright ones."""
    rows = []
    for normal, points in found:
        if abs(normal[2]) > _UPRIGHT or not len(points):
            continue
        angle = np.arctan2(normal[1], normal[0])
        across, along = np.array((np.cos(angle), np.sin(angle))), np.array((-np.sin(angle), np.cos(angle)))
        places = points[:, :2] @ along
        if np.ptp(places) >= _LEAST_M:
            rows.append((angle, float((points[:, :2] @ across).mean()), places.min(), places.max()))
    return np.array(rows).reshape(-1, 4)


def _hypotheses(known: FloatArray, seen: FloatArray) -> FloatArray:
    """Poses (N, 3), x, y, heading, at which two walls seen are two of the map."""
    poses = []
    for first, second in combinations(seen, 2):
        if abs(np.sin(first[0] - second[0])) < 0.3:
            continue  # they fix no place
        for one in known:
            heading = one[0] - first[0]
            other = known[np.abs(np.angle(np.exp(1j * (known[:, 0] - second[0] - heading)))) < _TURN_RAD]
            for two in other:
                normals = np.array([[np.cos(one[0]), np.sin(one[0])], [np.cos(two[0]), np.sin(two[0])]])
                place = np.linalg.solve(normals, (one[1] - first[1], two[1] - second[1]))
                poses.append((*place, np.angle(np.exp(1j * heading))))
    return np.array(poses).reshape(-1, 3)


def _explained(known: FloatArray, seen: FloatArray, pose: FloatArray) -> float:
    """Share of the lengths seen that lie along walls of the map."""
    x, y, heading = pose
    angles = seen[:, 0] + heading
    offsets = seen[:, 1] + np.cos(angles) * x + np.sin(angles) * y
    shifts = np.cos(angles) * y - np.sin(angles) * x
    turned = np.abs(np.angle(np.exp(1j * (known[None, :, 0] - angles[:, None])))) < _TURN_RAD
    fits = turned & (np.abs(known[None, :, 1] - offsets[:, None]) < _SHIFT_M)
    starts, ends = seen[:, 2] + shifts, seen[:, 3] + shifts
    low, high = np.maximum(known[None, :, 2], starts[:, None]), np.minimum(known[None, :, 3], ends[:, None])
    covered = np.where(fits, np.maximum(high - low, 0.0), 0.0).max(axis=1, initial=0.0)
    return float(covered.sum() / (seen[:, 3] - seen[:, 2]).sum())


def _told_in_space(pose: FloatArray) -> str:
    numbers = [*pose[:3, 3], *np.rad2deg(Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX"))]
    return ",".join(f"{number:.1f}" for number in numbers[:3]) + "," + ",".join(f"{a:.0f}" for a in numbers[3:])


def _told(pose: FloatArray) -> str:
    x, y, heading = planar_delta(pose)
    return f"{x:.1f},{y:.1f},{np.rad2deg(heading):.0f}"
