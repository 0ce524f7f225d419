"""Peer of ``benchmarks.factors``, run by an interpreter that has mrob (numpy < 2): reads an npz, prints JSON."""

import json
import sys
import time

import mrob  # pyright: ignore[reportMissingImports] (a peer, in an environment of its own)
import numpy as np


def solve(data, peer):
    """Build and optimise one graph: seconds to build, seconds to solve, root-mean-square position error."""
    points, labels, poses, initial, truth = (data[k] for k in ("points", "labels", "poses", "initial", "truth"))
    weight = 1.0 / float(data["sigma"]) ** 2
    start = time.process_time()
    graph = mrob.FGraph()
    nodes = [graph.add_node_pose_3d(mrob.geometry.SE3(pose)) for pose in initial[1:]]
    nodes.insert(0, graph.add_node_pose_3d(mrob.geometry.SE3(truth[0]), mrob.NODE_ANCHOR))
    n_planes = int(labels.max()) + 1
    if peer == "pi-factor":
        planes = [graph.add_node_plane_4d(row) for row in data["planes"]]
        for k, plane in enumerate(planes):
            for i, node in enumerate(nodes):
                seen = points[(labels == k) & (poses == i)]
                homogeneous = np.column_stack([seen, np.ones(len(seen))])
                graph.add_pi_factor_plane_4d(weight * homogeneous.T @ homogeneous, node, plane)
    else:
        for k in range(n_planes):
            plane = graph.add_eigen_factor_plane_dense()
            for i, node in enumerate(nodes):
                graph.eigen_factor_plane_add_points_array(plane, node, points[(labels == k) & (poses == i)], weight)
    built = time.process_time()
    iterations = graph.solve(
        mrob.LM_ELLIPS, 30
    )  # 0 says the 30 are used up; plain LM leaves the pi-factor's error larger
    solved = time.process_time()
    states = graph.get_estimated_state()
    estimate = np.stack([states[node][:3, 3] for node in nodes])
    error = np.sqrt(np.mean(np.sum((estimate - truth[:, :3, 3]) ** 2, axis=1)))
    return {"build_s": built - start, "solve_s": solved - built, "iterations": int(iterations), "error_m": float(error)}


if __name__ == "__main__":
    with np.load(sys.argv[1]) as archive:
        contents = dict(archive)
    print(json.dumps({peer: solve(contents, peer) for peer in ("pi-factor", "ef-dense")}))
