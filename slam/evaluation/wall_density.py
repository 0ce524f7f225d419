"""How many wall landmarks a metre of wall has: walls that are in the map twice show as a higher number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from slam.geometry.frames import lift
from slam.map.map_planes import MapPlane

#: Walls lean less than this from the vertical: sine.
_MAX_LEAN = 0.26
#: Walls nearer to each other than this, over one place of the plan, are counted as one metre of wall, m.
_SAME_M = 0.3


def metres_of_wall(planes: Sequence[MapPlane]) -> tuple[int, float]:
    """Number of walls among planes, and the length of wall that they cover in plan, m, each place once."""
    strips = []
    for plane in planes:
        if abs(float(plane.plane.normal[2])) > _MAX_LEAN:
            continue
        corners = lift(shapely.get_coordinates(plane.seen), plane.plane.frame)[:, :2]
        across = plane.plane.normal[:2] / np.linalg.norm(plane.plane.normal[:2])
        along = corners @ np.array((-across[1], across[0]))
        ends = corners[[int(np.argmin(along)), int(np.argmax(along))]]
        strips.append(shapely.LineString(ends).buffer(0.5 * _SAME_M, cap_style="flat"))
    return len(strips), float(shapely.union_all(strips).area / _SAME_M) if strips else 0.0
