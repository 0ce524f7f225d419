"""From log to map: how good, how long in which stage, how much memory; each mission in a process of its own.

Run as ``python -m benchmarks end_to_end``. One thread. Kernels come from the cache: a mission before has loaded nothing
else. Nothing surveyed is known of `loop5`; the figure is how far its long walls are from one another's right angles.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from benchmarks._measure import MEMORY, PROJECT, Row
from benchmarks._memory import process_peak_mb

DATA = PROJECT.parent / "shared" / "data"
#: Walls of at least this length, m, seen from at least so many keyframes, show whether the corridors are straight.
LONG_M, OFTEN = 6.0, 5


def timed_run(log: Any, rig: Any, load_s: float) -> tuple[Any, Row]:
    """A run and the columns of its times."""
    from slam.config import SlamConfig
    from slam.runs.slam_run import run_slam

    start, cpu = time.perf_counter(), time.process_time()
    done = run_slam(log, rig, SlamConfig())
    run_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    seconds = done.clock.seconds
    stamps = done.trajectory.stamps_ns
    return done, {
        "keyframes": len(done.trajectory),
        "planes": len(done.planes),
        "load s": load_s,
        "measure s": seconds.get("measure"),
        "estimate s": seconds.get("estimate"),
        "map s": seconds.get("map"),
        "CPU s": cpu_s,
        "ms per keyframe": 1e3 * run_s / len(stamps),
        "real-time factor": float(stamps[-1] - stamps[0]) * 1e-9 / (run_s + load_s),
    }


def demo(scans: int = 400) -> Row:
    """The demo's mission against its truth, odometry alone beside it."""
    from slam.evaluation import absolute_error
    from slam.simulation import simulate_mission

    mission = simulate_mission("corridor", n_scans=scans, seed=0)
    done, times = timed_run(mission.log, mission.rig, 0.0)
    errors = [
        1e3
        * float(np.sqrt(np.mean(absolute_error(path, mission.truth.trajectory, alignment="first").translation_m ** 2)))
        for path in (done.trajectory, done.odometry)
    ]
    words = f"position {errors[0]:.2f} mm rmse, odometry {errors[1]:.1f} mm"
    return {"accuracy": words, "gate": {"position, mm": errors[0]}, **times}


def loaded(name: str) -> tuple[Any, Any, float]:
    """Log, rig and the seconds to read them."""
    from slam.io.load import load

    start = time.perf_counter()
    log, rig = load(DATA / name)
    return log, rig, time.perf_counter() - start


def loop5() -> Row:
    """A log without truth: the directions of its long walls."""
    import shapely

    done, times = timed_run(*loaded("loop5/loop5.clf.gz"))
    angles = []
    for landmark in done.slam.landmarks:
        placed = done.slam.landmarks.placed(landmark.id)
        corners = shapely.get_coordinates(landmark.outline) @ placed.world_T_plane[:2, :2].T
        extent = np.ptp(corners @ placed.world_T_plane[:2, 0]) if len(corners) else 0.0
        if landmark.n_keyframes >= OFTEN and extent > LONG_M:
            angles.append(4.0 * np.arctan2(placed.normal[1], placed.normal[0]))
    apart = np.angle(np.exp(1j * (np.array(angles) - np.angle(np.exp(1j * np.array(angles)).mean()))))
    spread = float(np.rad2deg(np.abs(apart).max()) / 4.0)
    return {
        "accuracy": f"{len(angles)} long walls at most {spread:.2f} deg from right angles",
        "gate": {"walls, deg": spread},
        **times,
        "real-time factor": None,  # its stamps are line numbers
    }


def intel() -> Row:
    """Hand-verified relations; odometry's beside them."""
    from slam.evaluation.trajectories import read_relations, relation_errors

    done, times = timed_run(*loaded("intel/intel.clf.gz"))
    relations = read_relations(DATA / "intel" / "intel.relations.gz")
    words, gate = [], {}
    for path in (done.trajectory, done.odometry):
        errors = relation_errors(path, relations)
        turn = np.rad2deg(errors.rotation_rad.mean())
        words.append(f"{errors.translation_m.mean():.3f} m / {turn:.2f} deg")
        gate = gate or {"relations, m": float(errors.translation_m.mean()), "relations, deg": float(turn)}
    return {"accuracy": f"relations {words[0]}, odometry {words[1]}", "gate": gate, **times}


def corridor() -> Row:
    """Height and width of the corridor, and the distance to its better registration beside that of the two."""
    from slam.evaluation.map_summary import facing_pairs
    from slam.io.threedtk import read_frames

    done, times = timed_run(*loaded("3dtk_corridor"))
    pairs = facing_pairs(done.planes)
    size = {}
    for name in ("height", "width"):  # behind the window front of the corridor there is another wall
        size[name] = min(pair.distance_m for pair in pairs if pair.name == name)
    folder, away = DATA / "3dtk_corridor", []
    for path in ("estimate", "cf17522d"):
        gaps = []
        for index in (1, 2):
            better = read_frames(folder / f"scan00{index}.frames.4cc29d4c")
            other = (
                done.trajectory.poses[index]
                if path == "estimate"
                else read_frames(folder / f"scan00{index}.frames.{path}")
            )
            gaps.append(np.linalg.norm(better[:3, 3] - other[:3, 3]))
        away.append(100.0 * max(gaps))
    return {
        "accuracy": f"height {size['height']:.3f} m (2.42), width {size['width']:.3f} m (2.39), "
        f"{away[0]:.1f} cm from a registration, which is {away[1]:.1f} cm from another",
        "gate": {"size, m": max(abs(size["height"] - 2.42), abs(size["width"] - 2.39)), "registration, cm": away[0]},
        **times,
        "real-time factor": None,
    }


def hall() -> Row:
    """A spinning lidar against the lidar odometry it came with, itself 1 to 2 cm off, after alignment."""
    from slam.evaluation import absolute_error
    from slam.io.trajectories import Trajectory, read_tum

    done, times = timed_run(*loaded("balm_hall"))
    reference = read_tum(DATA / "balm_hall" / "lidar_odometry.tum")
    stamped = Trajectory(reference.stamps_ns[: len(done.trajectory)], done.trajectory.poses)  # clouds have no times
    error = float(np.sqrt(np.mean(absolute_error(stamped, reference).translation_m ** 2)))
    times["real-time factor"] = (
        float(np.ptp(reference.stamps_ns))
        * 1e-6
        / (times["ms per keyframe"] * len(done.trajectory) + 1e3 * times["load s"])
    )
    words = f"{100 * error:.1f} cm rmse from lidar odometry"
    return {"accuracy": words, "gate": {"position, cm": 100.0 * error}, **times}


def libraries() -> Row:
    """What is resident before anything is done."""
    import slam.planeslam
    import slam.runs.slam_run  # noqa: F401

    return {}


_MISSIONS: dict[str, tuple[str, Callable[[], Row]]] = {
    "libraries alone": ("", libraries),
    "demo mission, 400 scans": ("", demo),
    "loop5": ("loop5", loop5),
    "3dtk_corridor": ("3dtk_corridor", corridor),
    "balm_hall": ("balm_hall", hall),
    "intel": ("intel", intel),
}


def measured_mission(name: str) -> Row:
    """The row of a mission, or what its log lacks; its time also by the yardstick's, and the memory of this process."""
    ruler = yardstick()
    try:
        row: Row = _MISSIONS[name][1]()
    except ValueError as error:
        row = {"accuracy": f"did not run: {error}".replace(str(DATA), "data")}
    if row.get("CPU s"):
        row["CPU, x yardstick"] = row["CPU s"] / (0.5 * (ruler + yardstick()))
    return row | {MEMORY: process_peak_mb()}


def yardstick() -> float:
    """Seconds of a fixed piece of work, processor time: small numpy, loops of Python, a matrix product."""
    rng, start, total = np.random.default_rng(0), time.process_time(), 0.0
    big = rng.standard_normal((400, 400))
    for k in range(20_000):
        matrix = big[k % 100 : k % 100 + 3, :3]
        total += float((matrix @ matrix.T)[0, 0]) + sum(range(20))
    for _ in range(10):
        big = big @ big / np.linalg.norm(big @ big)
    return time.process_time() - start


def run(*, short: bool = False) -> list[Row]:
    """A row for each mission whose log is there; short: without the longest."""
    names = [name for name, (folder, _) in _MISSIONS.items() if (DATA / folder).is_dir()]
    wanted = [name for name in names if not (short and name == "intel")]
    return [{"mission": name, **in_own_process(name)} for name in wanted]


def in_own_process(name: str) -> Row:
    """The row of a mission by a process that does nothing else."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measured_mission, name).result()
