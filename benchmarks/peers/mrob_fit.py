"""Peer of `benchmarks.fit`, run by the peers' interpreter: reads groups of points (K, n, 3), prints JSON."""

import json
import sys

import mrob  # type: ignore[import-not-found]  # a peer, in an environment of its own
import numpy as np

from benchmarks._measure import Task, measured_here

if __name__ == "__main__":
    groups = np.load(sys.argv[1])["points"]
    fits = Task(
        "mrob",
        lambda: [mrob.estimate_plane(points) for points in groups],
        lambda planes: {"planes": [np.ravel(plane).tolist() for plane in planes]},
        int(sys.argv[2]),
    )
    print(json.dumps(measured_here(fits)))
