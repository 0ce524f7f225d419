"""A spatial index: which of many spheres come near a place, without looking at all of them."""

from __future__ import annotations

from math import isqrt

import numpy as np
import shapely

from spplanes._check import FloatArray

#: Boxes in the tree are wider than the spheres by this: what moves less needs no new tree, m.
_SLACK_M = 0.5
#: Rounding of coordinates up to 10,000 km, m.
_ROUNDING_M = 1e-6
#: Most spheres beside the tree, all of which are looked at, before it is made anew; to it comes the root of all.
_BESIDE = 32
#: So few in the tree are all of them "about": to test them takes less time than to ask the tree.
_FEW = 64


class SphereIndex:
    """Spheres by number in an R-tree (STR-packed) of their boxes seen from above, each box wider than its sphere.

    Landmarks move with every update and most of them hardly: a sphere that stays in its wide box is left in the tree.
    Those that left theirs, and new ones, are kept beside the tree until they are too many; then it is packed anew. What
    `about` gives may be more than what is near, never less, so who tests it decides as if all had been tested, however
    the tree came about.

    References:
        Leutenegger, Lopez, Edgington, "STR: a simple and efficient algorithm for R-tree packing", ICDE 1997.
    """

    def __init__(self) -> None:
        self._packed = np.empty(0, dtype=np.intp)
        self._wide = np.empty((0, 4))
        self._tree = shapely.STRtree([])
        self._beside = np.empty(0, dtype=np.intp)

    def place(self, numbers: np.ndarray, middles: FloatArray, radii: FloatArray) -> None:
        """All spheres there are, where they are now.

        Args:
            numbers: ascending, each once, shape (N,).
            middles, radii: shapes (N, 3) and (N,), m; one that is not finite is near nothing.
        """
        boxes = np.hstack((middles[:, :2] - radii[:, None], middles[:, :2] + radii[:, None]))
        real = np.isfinite(boxes).all(axis=1)
        numbers, boxes = numbers[real], boxes[real]
        slots = np.searchsorted(self._packed, numbers)
        kept = slots < len(self._packed)
        kept[kept] = self._packed[slots[kept]] == numbers[kept]
        at_home = kept.copy()
        wide = self._wide[slots[kept]]
        at_home[kept] = (wide[:, :2] <= boxes[kept, :2]).all(axis=1) & (boxes[kept, 2:] <= wide[:, 2:]).all(axis=1)
        gone = len(self._packed) - int(kept.sum())
        self._beside = numbers[~at_home]
        if len(self._beside) + gone > _BESIDE + isqrt(len(numbers)):
            self._pack(numbers, boxes)

    def about(self, middle: FloatArray, reach: float) -> list[int]:
        """Numbers of all spheres that come within `reach` (m) of a place (3,), and of some more, ascending.

        One that has been taken out since the last `place` may be among them.
        """
        if len(self._packed) <= _FEW:
            return sorted({*self._packed.tolist(), *self._beside.tolist()})
        (x, y), away = middle[:2].tolist(), reach + _ROUNDING_M
        found = self._tree.query(shapely.box(x - away, y - away, x + away, y + away))  # type: ignore[call-overload]
        return sorted({*self._packed[found].tolist(), *self._beside.tolist()})

    def _pack(self, numbers: np.ndarray, boxes: FloatArray) -> None:
        self._packed, self._beside = numbers, numbers[:0]
        self._wide = boxes + _SLACK_M * np.array([-1.0, -1.0, 1.0, 1.0])
        self._tree = shapely.STRtree(shapely.box(*self._wide.T))
