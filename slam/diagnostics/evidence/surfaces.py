"""Planes of a map as what stops rays: free space, doubled surfaces, planes seen from two places against each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from factors.association.observations import planes_of
from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, at_least, named
from slam.diagnostics.views import TOLERANCE_M, V, compare, pairs_of, way_along
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.geometry.frames import evenly, inverse, lift
from slam.geometry.polygons import flatten, polygonal, valid
from slam.planeslam import PlaneSlam
from slam.registration.visibility import LinesOfSight, points_on
from slam.sensors.rig import Sensor
from spplanes import Plane
from spplanes._check import FloatArray

#: Planes whose normals are within 10 deg may be one.
ALIKE = float(np.cos(np.deg2rad(10.0)))

_Area = shapely.Polygon | shapely.MultiPolygon


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The planes of a map as what stops rays."""

    ids: tuple[int, ...]
    """Landmarks."""
    walls: tuple[tuple[FloatArray, _Area], ...]
    """Frame (4, 4) in the world and outline, less its border, of each."""

    @classmethod
    def of(cls, run: PlaneSlam) -> Surfaces:
        """Landmarks that are part of the map and have an area."""
        wanted = run.config.landmarks.min_observations
        found = []
        for landmark in run.landmarks:
            outline = polygonal(valid(landmark.outline)) if landmark.n_keyframes >= wanted else None
            if (inner := _without_border(outline)) is not None:
                shapely.prepare(inner)
                found.append((landmark.id, run.landmarks.placed(landmark.id).world_T_plane, inner))
        return cls(tuple(one[0] for one in found), tuple(one[1:] for one in found))


def _without_border(outline: _Area | None) -> _Area | None:
    """What rays cannot pass beside; None where an outline is all border, 0.1 m: outlines are rougher nowhere."""
    inner = None if outline is None else outline.buffer(-0.1)
    return inner if isinstance(inner, (shapely.Polygon, shapely.MultiPolygon)) and not inner.is_empty else None


def stopped_rays(keyframes: Sequence[Keyframe], poses: FloatArray, surfaces: Surfaces, sensor: Sensor) -> Counter[int]:
    """Rays of a sensor to the planes that keyframes at poses (N, 4, 4) saw: how many each landmark would stop.

    A 3D sensor sees all from one place; the plane that a slice turns in passes what it sees as the body goes ahead.
    """
    found: Counter[int] = Counter()
    body_T_sensor, moves_on = sensor.body_T_sensor, sensor.kind == "slice"
    ahead = body_T_sensor[0, :3]  # the body's x axis in the frame of the sensor
    if moves_on and abs(ahead[2]) < 0.5:
        return found  # it turns in the way it goes, up to 30 deg: who knows from where it saw what
    for index in evenly(len(keyframes), 60):
        seen = [plane.transform(inverse(body_T_sensor)) for plane in planes_of(keyframes[index].observations)]
        sight = LinesOfSight.between(seen, np.ones(len(seen)), ())
        starts = sight.ends[:, 2:] / ahead[2] * ahead if moves_on else sight.starts
        stopped_by = replace(sight, walls=surfaces.walls, starts=starts).stopped_by(poses[index] @ body_T_sensor)
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
        if (inner := _without_border(outline)) is not None:
            walls.append((inverse(body_T_sensor) @ frame, inner))
        local = lift(places, inverse(frame))
        alike = (normals @ frame[:3, 2] > ALIKE) & (np.abs(local[:, 2]) < TOLERANCE_M)
        confirmed |= alike & shapely.contains_xy(outline, local[:, 0], local[:, 1])
    sight = LinesOfSight(lift(places, inverse(body_T_sensor)), np.ones(len(places)), tuple(walls))
    stopped = sight.stopped_by(np.eye(4)) >= 0
    size = np.bincount(numbers, minlength=len(seen))
    mostly = [2.0 * np.bincount(numbers, weights=some, minlength=len(seen)) > size for some in (confirmed, stopped)]
    return int(mostly[0].sum()), int((mostly[1] & ~mostly[0]).sum())


def free_space_evidence(views: Mapping[int, V], poses: FloatArray) -> Iterator[Evidence]:
    """Looks through surfaces that other keyframes saw, at the final poses (N, 4, 4).

    That a surface was not there when another keyframe looked happens to `NOVEL_SHARE` of looks even about one place:
    people, doors, glass and edges. Each place has a binomial test, and its share of the significance (Bonferroni): one
    that fails is of poses that do not fit together. Where the whole drive fails, all of it is broken.
    """
    places: dict[Hashable, int] = {}
    stretch, pairs = np.floor(way_along(poses)).astype(int).tolist(), pairs_of(sorted(views), poses)
    if not pairs:
        return
    counts = np.array([compare(views[a], views[b], inverse(poses[a]) @ poses[b]) for a, b in pairs])
    own = np.array([places.setdefault(tuple(sorted((stretch[a], stretch[b]))), len(places)) for a, b in pairs])
    confirmed, through = (np.bincount(own, column).astype(int) for column in counts.T)
    looks = confirmed + through
    p_values = np.minimum(len(places) * at_least(through, looks, NOVEL_SHARE), 1.0)
    wrong = p_values < SIGNIFICANCE
    if not wrong.any():
        return
    frames = tuple(np.unique(np.array(pairs)[wrong[own]]).tolist())
    whole = float(at_least(through.sum(), looks.sum(), NOVEL_SHARE))
    gone, seen = int(through[wrong].sum()), int(looks[wrong].sum())
    sentence = (
        f"at {named(frames)} {100.0 * gone / seen:.0f} % of {seen} looks go through surfaces that other keyframes saw "
        f"({100.0 * through.sum() / looks.sum():.1f} % of {looks.sum()} in the whole run)"
    )
    grade = "broken" if whole < SIGNIFICANCE else "doubtful"
    yield Evidence("free space", grade, float(p_values.min()), gone / seen, "of looks", frames, sentence)


def doubled_evidence(run: PlaneSlam, surfaces: Surfaces) -> Iterator[Evidence]:
    """Planes of the map that lie to at least half over a larger one that faces the same way, centimetres apart.

    Boards on walls do, and things that stand against them: a share of `NOVEL_SHARE` may. A drive that came back a
    little off leaves every surface twice.
    """
    pairs, count = doubled_pairs(surfaces), len(surfaces.ids)
    if not pairs:
        return
    twice = sorted({younger for _, younger, _ in pairs})
    frames = tuple(sorted({sighting.keyframe for key in twice for sighting in run.landmarks[key].sightings}))
    gap = float(np.median([abs(gap) for _, _, gap in pairs]))
    p_value = float(at_least(len(twice), count, NOVEL_SHARE))
    sentence = f"{len(twice)} of {count} planes are in the map twice, {gap:.2g} m apart, seen at {named(frames)}"
    yield Evidence("doubled surfaces", "doubtful", p_value, len(twice) / count, "of planes", frames, sentence)


def doubled_pairs(surfaces: Surfaces) -> list[tuple[int, int, float]]:
    """Landmarks (larger, smaller) that double each other, and the distance between, m; each smaller one once.

    Nearer than 2 cm two planes are one for all that a map is used for; further apart than 0.3 m they are one before the
    other, and not one twice: there rays tell.
    """
    if not surfaces.ids:
        return []
    frames = np.array([frame for frame, _ in surfaces.walls])
    areas = np.array([outline.area for _, outline in surfaces.walls])
    found = []
    for small in range(len(areas)):
        larger = areas > areas[small]
        larger[:small] |= areas[:small] == areas[small]
        frame, outline = surfaces.walls[small]
        centre = frame[:3, :2] @ np.array([outline.centroid.x, outline.centroid.y]) + frame[:3, 3]
        gaps = np.einsum("ni,ni->n", centre - frames[:, :3, 3], frames[:, :3, 2])
        alike = frames[:, :3, 2] @ frames[small, :3, 2] > ALIKE
        near = (np.abs(gaps) > 0.02) & (np.abs(gaps) < 0.3)
        for large in np.flatnonzero(larger & alike & near).tolist():
            larger_frame, larger_outline = surfaces.walls[large]
            moved = valid(flatten(outline, inverse(larger_frame) @ frame))
            if float(shapely.intersection(larger_outline, moved).area / outline.area) >= 0.5:
                found.append((surfaces.ids[large], surfaces.ids[small], float(gaps[large])))
                break
    return found
