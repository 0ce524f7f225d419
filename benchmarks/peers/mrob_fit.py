"""Peer of `benchmarks.fit`, run by the peers' interpreter: reads groups of points (K, n, 3), prints JSON."""

import json
import sys

import mrob  # type: ignore[import-not-found]  # a peer, in an environment of its own
import numpy as np

from benchmarks.peers.timing import measured

if __name__ == "__main__":
    groups = np.load(sys.argv[1])["points"]
    planes, row = measured(lambda: [mrob.estimate_plane(points) for points in groups], sys.argv[2])
    print(json.dumps({**row, "planes": [np.ravel(plane).tolist() for plane in planes]}))
