"""Time to find what an observation may be, over the size of the map: by the spatial index and by looking at all.

Maps of square halls side by side, twelve planes each; queries are those of a keyframe, a dozen planes about one place.
Between two queries every landmark moves by a few millimetres, as updates move them, so the index is kept up to date
as in a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slam.geometry.sphere_index import SphereIndex

#: Side of a hall, m; its planes; how far an update moves a landmark, m; how near to a place a candidate must come, m.
SIDE_M, PLANES, MOVED_M, REACH_M = 8.0, 12, 0.003, 1.5
#: Queries of a keyframe, and keyframes timed.
QUERIES, KEYFRAMES = 12, 30


def run(short: bool = False) -> list[dict]:
    """One row for every size of map."""
    return [row(halls) for halls in ((8, 80, 800) if short else (8, 80, 800, 8000))]


def row(halls: int) -> dict:
    """Both ways on one map; they find the same."""
    rng = np.random.default_rng(halls)
    across = int(np.ceil(np.sqrt(halls)))
    corner = SIDE_M * np.column_stack((np.arange(halls) % across, np.arange(halls) // across))
    middles = np.repeat(np.column_stack((corner, np.zeros(halls))), PLANES, axis=0)
    middles = middles + rng.uniform(0.0, SIDE_M, middles.shape) * [1.0, 1.0, 0.4]
    radii, numbers = rng.uniform(0.3, 4.0, len(middles)), np.arange(len(middles))
    index, seconds, found = SphereIndex(), {"place": [], "index": [], "all": []}, 0
    index.place(numbers, middles, radii)
    for _ in range(KEYFRAMES):
        middles = middles + MOVED_M * rng.standard_normal(middles.shape)
        places = middles[rng.integers(len(middles))] + rng.standard_normal((QUERIES, 3))

        def by_index(middles: np.ndarray = middles, places: np.ndarray = places) -> list[list[int]]:
            about = [np.array(index.about(place, REACH_M), dtype=np.intp) for place in places]
            return [
                rows[_near(middles[rows], radii[rows], place)].tolist()
                for rows, place in zip(about, places, strict=True)
            ]

        def by_all(middles: np.ndarray = middles, places: np.ndarray = places) -> list[list[int]]:
            return [numbers[_near(middles, radii, place)].tolist() for place in places]

        def place(middles: np.ndarray = middles) -> None:
            index.place(numbers, middles, radii)

        _timed(place, seconds["place"])
        ours, theirs = _timed(by_index, seconds["index"]), _timed(by_all, seconds["all"])
        if ours != theirs:
            raise RuntimeError(f"index: expected {theirs}, got {ours}")
        found += sum(map(len, ours))
    ms = {name: 1e3 * float(np.median(times)) for name, times in seconds.items()}
    return {
        "landmarks": len(numbers),
        "candidates each": found / (KEYFRAMES * QUERIES),
        "by the index, ms a keyframe": ms["index"],
        "by looking at all, ms": ms["all"],
        "keeping the index, ms an update": ms["place"],
    }


def _near(middles: np.ndarray, radii: np.ndarray, place: np.ndarray) -> np.ndarray:
    return np.linalg.norm(middles - place, axis=1) <= radii + REACH_M


def _timed(what: Callable[[], Any], into: list[float]) -> Any:
    start = time.process_time()
    found = what()
    into.append(time.process_time() - start)
    return found


if __name__ == "__main__":
    for one in run():
        print("  ".join(f"{name}: {value:.4g}" for name, value in one.items()))
