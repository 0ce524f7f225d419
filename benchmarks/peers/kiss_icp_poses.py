"""Peer of `benchmarks.lidar`, run by the peers' interpreter: reads clouds, prints time and positions of KISS-ICP."""

import json
import sys

import numpy as np
from kiss_icp.config import load_config  # type: ignore[import-not-found]  # a peer, in an environment of its own
from kiss_icp.kiss_icp import KissICP  # type: ignore[import-not-found]

from benchmarks._measure import Task, measured_here


def poses_of(clouds, voxel_m):
    """Poses (K, 4, 4) of clouds (K, N, 3), NaN for no return, each seen at once, by one thread."""
    config = load_config(None)
    config.data.deskew, config.data.min_range, config.data.max_range = False, 0.3, 40.0
    config.mapping.voxel_size, config.registration.max_num_threads = voxel_m, 1
    odometry, poses = KissICP(config), []
    for cloud in clouds:
        seen = cloud[np.isfinite(cloud[:, 0])].astype(np.float64)
        odometry.register_frame(seen, np.zeros(len(seen)))
        poses.append(odometry.last_pose)
    return np.array(poses)


def main(path, voxel_m, repeats):
    with np.load(path) as archive:
        clouds = archive["clouds"]
    work, score = lambda: poses_of(clouds, float(voxel_m)), lambda poses: {"positions": poses[:, :3, 3].tolist()}
    print(json.dumps(measured_here(Task("KISS-ICP", work, score, int(repeats)))))


if __name__ == "__main__":
    main(*sys.argv[1:])
