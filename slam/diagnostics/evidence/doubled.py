"""Evidence: surfaces that are in the map twice, centimetres apart."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely

from slam.diagnostics.evidence._binomial import at_least
from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.evidence.surfaces import ALIKE, Surfaces
from slam.diagnostics.verdict import Evidence, named
from slam.frontend.occupancy import NOVEL_SHARE
from slam.geometry.frames import inverse
from slam.geometry.polygons import flatten, valid
from spplanes._check import FloatArray

#: Planes are one before the other, not one twice, from this distance on, m: there rays tell.
_APART_M = 0.3
#: Nearer than this two planes are one for all that a map is used for, m.
_TOGETHER_M = 0.02
#: Least share of the smaller of two planes that lies over the other.
_OVERLAP = 0.5


def doubled_evidence(run: Finished, surfaces: Surfaces) -> Iterator[Evidence]:
    """Planes of the map that lie to at least half over a larger one that faces the same way, centimetres apart.

    Boards on walls do, and things that stand against them: a share of `NOVEL_SHARE` may. A drive that came back a
    little off leaves every surface twice.
    """
    pairs = doubled_pairs(surfaces)
    count = len(surfaces.ids)
    if not pairs:
        return
    twice = sorted({younger for _, younger, _ in pairs})
    frames = tuple(sorted({one.keyframe for key in twice for one in run.landmarks[key].sightings}))
    gap = float(np.median([abs(gap) for _, _, gap in pairs]))
    yield Evidence(
        "doubled surfaces",
        "doubtful",
        float(at_least(len(twice), count, NOVEL_SHARE)),
        len(twice) / count,
        "of planes",
        frames,
        f"{len(twice)} of {count} planes are in the map twice, {gap:.2g} m apart, seen at {named(frames)}",
    )


def doubled_pairs(surfaces: Surfaces) -> list[tuple[int, int, float]]:
    """Landmarks (larger, smaller) that double each other, and the distance between, m; each smaller one once."""
    if not surfaces.ids:
        return []
    frames = np.array([frame for frame, _ in surfaces.walls])
    areas = np.array([outline.area for _, outline in surfaces.walls])
    found = []
    for small in range(len(areas)):
        larger = areas > areas[small]
        larger[:small] |= areas[:small] == areas[small]
        centre = _centre(*surfaces.walls[small])
        gaps = np.einsum("ni,ni->n", centre - frames[:, :3, 3], frames[:, :3, 2])
        alike = frames[:, :3, 2] @ frames[small, :3, 2] > ALIKE
        near = (np.abs(gaps) > _TOGETHER_M) & (np.abs(gaps) < _APART_M)
        for large in np.flatnonzero(larger & alike & near).tolist():
            if _overlap(surfaces, large, small) >= _OVERLAP:
                found.append((surfaces.ids[large], surfaces.ids[small], float(gaps[large])))
                break
    return found


def _centre(frame: FloatArray, outline: shapely.Polygon | shapely.MultiPolygon) -> FloatArray:
    """A plane's middle in the world, shape (3,)."""
    return frame[:3, :2] @ np.array([outline.centroid.x, outline.centroid.y]) + frame[:3, 3]


def _overlap(surfaces: Surfaces, large: int, small: int) -> float:
    """Share of the smaller plane that lies over the larger one."""
    (frame, outline), (other_frame, other) = surfaces.walls[large], surfaces.walls[small]
    moved = valid(flatten(other, inverse(frame) @ other_frame))
    return float(shapely.intersection(outline, moved).area / other.area)
