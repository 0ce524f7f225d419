"""Evidence about the prior map: its planes that were not seen again, or were looked through."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import shapely

from slam.diagnostics.evidence.surfaces import Surfaces, stopped_rays
from slam.diagnostics.verdict import Evidence, at_least, named
from slam.diagnostics.views import View, held_against
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.geometry.frames import inverse, lift
from slam.map.landmarks import Landmark
from slam.planeslam import PlaneSlam
from slam.sensors.rig import Rig
from spplanes._check import FloatArray


def _fix_a_place(normals: Sequence[FloatArray]) -> bool:
    """Whether planes of these normals, two of them 15 deg apart, fix a place on the floor between them."""
    walls = np.array([normal[:2] for normal in normals]).reshape(-1, 2)
    across = walls[:, None, 0] * walls[None, :, 1] - walls[:, None, 1] * walls[None, :, 0]
    return bool(np.abs(across).max(initial=0.0) > 0.26)


def prior_evidence(run: PlaneSlam, rig: Rig, views: Mapping[int, View], surfaces: Surfaces) -> Iterator[Evidence]:
    """A prior map none of whose planes was seen again, or too many of which are not there.

    Planes that nothing was matched to are missed where, at the final poses, more was seen through them than at them. Of
    planes in view a share of `NOVEL_SHARE` may have gone since: doors, boards, furniture.
    """
    frames, known = tuple(range(len(run.keyframes))), [landmark for landmark in run.landmarks if landmark.known]
    seen = [one.id for one in known if one.sightings or one.seen_by_past]
    if not seen:
        sentence = f"none of the {len(known)} planes of the prior map was seen again at {named(frames)}"
        yield Evidence("prior map", "broken", 0.0, 0.0, "of planes", frames, sentence)
        return
    if not _fix_a_place([run.landmarks.placed(key).normal for key in seen]):
        sentence = f"the planes of the prior map seen again, {len(seen)} of {len(known)}, do not fix a place in it"
        yield Evidence("prior map", "doubtful", 0.0, 0.0, "of planes", frames, f"{sentence} ({named(frames)})")
        return
    through = Counter(_through(known, run, views))
    for sensor in (rig.of_kind("cloud") or rig.of_kind("slice")).values():
        through.update(stopped_rays(run.keyframes, run.trajectory.poses, surfaces, sensor))
    missed = sum(one.id not in seen and through[one.id] > 0 for one in known)
    in_view = len(seen) + missed
    p_value = float(at_least(missed, in_view, NOVEL_SHARE))
    sentence = (
        f"{missed} of the {in_view} planes of the prior map that should have been seen at {named(frames)} were looked "
        f"through instead, {len(seen)} were seen again"
    )
    yield Evidence("prior map", "doubtful", p_value, missed / in_view, "of planes", frames, sentence)


def _through(known: Sequence[Landmark], run: PlaneSlam, views: Mapping[int, View]) -> dict[int, int]:
    """Looks of level lasers through prior planes less looks that confirm them, by landmark."""
    poses, balance = run.trajectory.poses, {}
    for landmark in known:
        places = _places_on(landmark, run.landmarks.placed(landmark.id).world_T_plane)
        looks = (held_against(view, lift(places, inverse(poses[k]))[:, :2]) for k, view in views.items())
        balance[landmark.id] = sum(through - confirmed for confirmed, through in looks)
    return balance


def _places_on(landmark: Landmark, world_T_plane: FloatArray) -> FloatArray:
    """Places every 0.5 m along an upright plane, at half its height, in the world, (N, 3); none on floors and ceilings.

    Only those are asked about whose vertical in the plane meets what was seen of it.
    """
    if abs(world_T_plane[2, 2]) > np.sqrt(0.5):
        return np.empty((0, 3))
    across = np.cross([0.0, 0.0, 1.0], world_T_plane[:3, 2])
    direction = world_T_plane[:3, :2].T @ across
    corners = landmark.extent.corners
    middle, along = corners.mean(axis=0), (corners - corners.mean(axis=0)) @ direction
    steps = np.arange(along.min() + 0.25, along.max(), 0.5)
    flat = middle + steps[:, None] * direction
    up = world_T_plane[2, :2] / max(float(np.linalg.norm(world_T_plane[2, :2])), 1e-9)
    verticals = shapely.linestrings(np.stack((flat - 10.0 * up, flat + 10.0 * up), axis=1))
    return lift(flat[shapely.distance(verticals, landmark.outline) < 1e-3], world_T_plane)
