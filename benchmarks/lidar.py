"""A spinning lidar without odometry: ours from clouds to map, KISS-ICP from the same clouds to poses.

Run as ``python -m benchmarks lidar``. Simulated drives of the corpus, 32 rings of 900 beams: an office, a cluttered
room and a hall. KISS-ICP knows all of a cloud to be of one moment, and no more of the sensor.
"""

from functools import cache, partial

import numpy as np

from benchmarks._measure import Case, Peer, Row, Task, measured
from benchmarks.corpus.drives import Recipe, make_drive
from benchmarks.peers import environment
from slam.config import SlamConfig
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.runs.slam_run import run_slam
from slam.sensors.log import CloudScan, Log
from slam.sensors.rig import Rig
from spplanes._check import FloatArray

#: Edges of the voxels of KISS-ICP's map, m; by itself it takes a hundredth of the farthest range, 40 m here, 100 m if
#: nobody says.
VOXELS_M = (0.2, 0.4, 1.0)


@cache
def _drive(name: str, seed: int) -> tuple[Log, Rig, FloatArray]:
    """Log, rig, and true positions (K, 3) of the clouds, from the first one's body."""
    drive = make_drive(Recipe.parse(name), seed)
    stamps = np.array([one.stamp_ns for one in drive.log.scans() if isinstance(one, CloudScan)])
    return drive.log, drive.rig, _from_first(drive.truth.poses_at(stamps))


def ours(name: str, seed: int) -> Trajectory:
    """The whole run, its verdict with it; of a log that nobody has looked at: what it shows of its noise is kept."""
    log, rig, _ = _drive(name, seed)
    run = run_slam(Log(log.events, log.source), rig, SlamConfig())
    assert run.verdict
    return run.scan_trajectory


def by_kiss_icp(name: str, seed: int, voxel_m: float, repeats: int) -> Row:
    """The row of KISS-ICP, by its own interpreter."""
    log, _, _ = _drive(name, seed)
    clouds = np.array([one.points.reshape(-1, 3) for one in log.scans() if isinstance(one, CloudScan)])
    row = environment.call("kiss_icp_poses", {"clouds": clouds.astype(np.float32)}, str(voxel_m), str(repeats))
    return score(name, seed, np.array(row.pop("positions"))) | row


def score(name: str, seed: int, positions: FloatArray) -> Row:
    """Root-mean-square error of positions (K, 3) from the first body."""
    off = np.linalg.norm(positions - _drive(name, seed)[2], axis=1)
    return {"clouds": len(positions), "position, mm rms": 1e3 * float(np.sqrt(np.mean(off**2)))}


def _from_first(poses: FloatArray) -> FloatArray:
    """Positions (K, 3) of poses (K, 4, 4) from the first one."""
    return (inverse(poses[0]) @ poses)[:, :3, 3]


def _case(name: str, seed: int) -> list[Task | Peer]:
    own = Task("spplanes", partial(ours, name, seed), lambda one: score(name, seed, _from_first(one.poses)), repeats=2)
    peers = [Peer(f"KISS-ICP, voxels of {size:g} m", partial(by_kiss_icp, name, seed, size), 2) for size in VOXELS_M]
    return [own, *peers]


CASES: dict[str, Case] = {
    f"{name.split('/')[0]} {seed}": partial(_case, name, seed)
    for name, seed in (("office/lidar32/absent", 5), ("cluttered/lidar32/absent", 6), ("hall/lidar32/absent", 7))
}


def run(*, short: bool = False) -> list[Row]:
    """Rows of all drives; of the first one where it is to be short."""
    return measured("benchmarks.lidar", dict(list(CASES.items())[:1]) if short else CASES, short=short)
