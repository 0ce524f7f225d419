"""Peer of `benchmarks.views`, run by the peers' interpreter: reads samples, prints errors and time a sample."""

import json
import sys

import mrob  # type: ignore[import-not-found]  # a peer, in an environment of its own
import numpy as np

from benchmarks.peers.timing import measured


def solve(data, peer):
    """Positions (P, 3) of the poses: build and optimise one graph."""
    points, labels, poses, initial, truth = (data[k] for k in ("points", "labels", "poses", "initial", "truth"))
    weight = 1.0 / float(data["sigma"]) ** 2
    graph = mrob.FGraph()
    nodes = [graph.add_node_pose_3d(mrob.geometry.SE3(pose)) for pose in initial[1:]]
    nodes.insert(0, graph.add_node_pose_3d(mrob.geometry.SE3(truth[0]), mrob.NODE_ANCHOR))
    n_planes = int(labels.max()) + 1
    order = np.argsort(poses * n_planes + labels, kind="stable")  # sorted once: a mask for every pair would cost more
    starts = np.searchsorted((poses * n_planes + labels)[order], np.arange(len(nodes) * n_planes + 1))
    parts = [points[some] for some in np.split(order, starts[1:-1])]
    for k in range(n_planes):
        if peer == "pi-factor":
            plane = graph.add_node_plane_4d(data["planes"][k])
        else:
            plane = graph.add_eigen_factor_plane_dense()
        for i, node in enumerate(nodes):
            seen = parts[i * n_planes + k]
            if len(seen) == 0:
                continue
            if peer == "pi-factor":
                homogeneous = np.column_stack([seen, np.ones(len(seen))])
                graph.add_pi_factor_plane_4d(weight * homogeneous.T @ homogeneous, node, plane)
            else:
                graph.eigen_factor_plane_add_points_array(plane, node, seen, weight)
    graph.solve(mrob.LM_ELLIPS, 30)  # plain LM leaves the pi-factor's error larger
    states = graph.get_estimated_state()
    return np.stack([states[node][:3, 3] for node in nodes])


def main(path, peer, repeats):
    """Print the row."""
    scenes = {}
    with np.load(path) as archive:
        for name in archive.files:
            k, field = name.split("/")
            scenes.setdefault(int(k), {})[field] = archive[name]
    scenes = [scenes[k] for k in sorted(scenes)]
    found, row = measured(lambda: [solve(scene, peer) for scene in scenes], repeats)
    errors = [
        np.sqrt(np.mean(np.sum((positions - scene["truth"][:, :3, 3]) ** 2, axis=1)))
        for positions, scene in zip(found, scenes, strict=True)
    ]
    print(json.dumps({**row, "errors_m": errors}))


if __name__ == "__main__":
    main(*sys.argv[1:])
