"""What 3D scans say of the planes of the map: rays to what was seen that planes of the map would have stopped."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.evidence.free_space import Place, seen_through
from slam.diagnostics.verdict import Evidence
from slam.diagnostics.views.comparing import TOLERANCE_M
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import planes_of
from slam.geometry.frames import inverse, lift
from slam.geometry.polygons import polygonal, valid
from slam.registration.visibility import LinesOfSight, points_on
from spplanes import Plane
from spplanes._check import FloatArray

#: Keyframes whose rays are cast, evenly over the run: the sample of a long one is as good.
_MOST_KEYFRAMES = 60
#: A ray counts as through a plane so far inside its border, m: outlines are rougher than this nowhere.
_INSIDE_M = 0.1
#: Planes whose normals are within 10 deg may be one.
ALIKE = float(np.cos(np.deg2rad(10.0)))


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The planes of a map as what stops rays."""

    ids: tuple[int, ...]
    """Landmarks."""
    walls: tuple[tuple[FloatArray, shapely.Polygon | shapely.MultiPolygon], ...]
    """Frame (4, 4) in the world and outline, less its border, of each."""

    @classmethod
    def of(cls, run: Finished) -> Surfaces:
        """Landmarks that are part of the map and have an area."""
        wanted = run.config.landmarks.min_observations
        found = []
        for landmark in run.landmarks:
            outline = polygonal(valid(landmark.outline)) if landmark.n_keyframes >= wanted else None
            inner = None if outline is None else outline.buffer(-_INSIDE_M)
            if isinstance(inner, (shapely.Polygon, shapely.MultiPolygon)) and not inner.is_empty:
                shapely.prepare(inner)
                found.append((landmark.id, run.landmarks.placed(landmark.id).world_T_plane, inner))
        return cls(tuple(one[0] for one in found), tuple(one[1:] for one in found))


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of one keyframe to the planes that it saw, against the map."""

    keyframe: int
    """Which."""
    of_plane: np.ndarray
    """Number of the plane each ray goes to, among those with an outline, shape (N,)."""
    stopped_by: np.ndarray
    """Which of the surfaces would have stopped it, -1 for none, shape (N,)."""

    @cached_property
    def through(self) -> int:
        """Planes seen to at least half through others."""
        counts = np.bincount(self.of_plane)
        stopped = np.bincount(self.of_plane, weights=self.stopped_by >= 0)
        return int((2.0 * stopped >= counts).sum()) if len(self.of_plane) else 0

    @cached_property
    def looks(self) -> int:
        """Planes seen."""
        return len(np.unique(self.of_plane))


def rays_of(
    keyframes: Sequence[Keyframe], poses: FloatArray, surfaces: Surfaces, body_T_sensor: FloatArray
) -> list[Rays]:
    """Rays of keyframes of a 3D sensor at poses (N, 4, 4)."""
    count = len(keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_KEYFRAMES)).round().astype(int)).tolist()
    found = []
    for index in chosen:
        planes = planes_of(keyframes[index].observations)
        ends = [points_on(plane.transform(inverse(body_T_sensor))) for plane in planes]
        ends = [some for some in ends if len(some)]
        if not ends:
            continue
        numbers = np.repeat(np.arange(len(ends)), [len(some) for some in ends])
        sight = LinesOfSight(np.concatenate(ends), np.ones(len(numbers)), surfaces.walls)
        found.append(Rays(index, numbers, sight.stopped_by(poses[index] @ body_T_sensor)))
    return found


def surface_evidence(rays: Sequence[Rays]) -> Iterator[Evidence]:
    """Planes seen through planes of the map, keyframe by keyframe."""
    places: dict[Hashable, Place] = {}
    for one in rays:
        places.setdefault(one.keyframe, Place()).add(one.looks, one.through, [one.keyframe])
    yield from seen_through(places, "planes seen lie behind planes of the map")


def agreement(
    seen: Sequence[Plane], others: Sequence[Plane], seen_T_others: FloatArray, body_T_sensor: FloatArray
) -> tuple[int, int]:
    """Of planes seen from one body how many lie on planes seen from another, and how many are seen through those."""
    ends = [points_on(plane) for plane in seen]
    numbers = np.repeat(np.arange(len(seen)), [len(some) for some in ends])
    if not len(numbers):
        return 0, 0
    places = np.concatenate(ends)
    walls, confirmed = [], np.zeros(len(places), dtype=bool)
    normals = np.array([plane.normal for plane in seen])[numbers]
    for other in others:
        frame, outline = seen_T_others @ other.frame, other.outline
        if outline is None:
            continue
        inner = outline.buffer(-_INSIDE_M)
        if isinstance(inner, (shapely.Polygon, shapely.MultiPolygon)) and not inner.is_empty:
            walls.append((inverse(body_T_sensor) @ frame, inner))
        local = lift(places, inverse(frame))
        alike = (normals @ frame[:3, 2] > ALIKE) & (np.abs(local[:, 2]) < TOLERANCE_M)
        confirmed |= alike & shapely.contains_xy(outline, local[:, 0], local[:, 1])
    sight = LinesOfSight(lift(places, inverse(body_T_sensor)), np.ones(len(places)), tuple(walls))
    stopped = sight.stopped_by(np.eye(4)) >= 0
    size = np.bincount(numbers, minlength=len(seen))
    mostly = [2.0 * np.bincount(numbers, weights=some, minlength=len(seen)) > size for some in (confirmed, stopped)]
    return int(mostly[0].sum()), int((mostly[1] & ~mostly[0]).sum())
