"""Planes of a map as what stops rays, and planes seen from two places against each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from slam.diagnostics.evidence.finished import Finished
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


def stopped_rays(
    keyframes: Sequence[Keyframe], poses: FloatArray, surfaces: Surfaces, body_T_sensor: FloatArray
) -> Counter[int]:
    """Rays of a 3D sensor to the planes that keyframes at poses (N, 4, 4) saw: how many each landmark would stop."""
    count = len(keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_KEYFRAMES)).round().astype(int)).tolist()
    found: Counter[int] = Counter()
    for index in chosen:
        seen = [plane.transform(inverse(body_T_sensor)) for plane in planes_of(keyframes[index].observations)]
        sight = replace(LinesOfSight.between(seen, np.ones(len(seen)), ()), walls=surfaces.walls)
        stopped_by = sight.stopped_by(poses[index] @ body_T_sensor)
        found.update(surfaces.ids[number] for number in stopped_by[stopped_by >= 0].tolist())
    return found


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
