"""Compile the kernels: small jobs that call them all, several at a time, each in a process of its own.

Usage: python tools/compile_kernels.py [--jobs N] [--run JOB]... [--into FOLDER]

Without `--into` the machine code is where numba keeps it, beside the sources: what `make demo` and `make test` do once,
so that nothing that follows waits. With `--into` it is compiled for a processor that others have too (`spplanes._jit`),
and what is called from Python is copied into FOLDER: what a wheel brings.
"""

import argparse
import contextlib
import fcntl
import gc
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parent.parent
PACKAGES = ("spplanes", "factors", "slam")


def main() -> int:
    """Read the command line; exit code 1 where a job failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--jobs", type=int, default=(os.cpu_count() or 1) + 1, help="processes at a time: one may wait for another"
    )
    parser.add_argument("--run", choices=sorted(JOBS), action="append", help="these jobs alone")
    parser.add_argument("--into", type=Path, help="folder for the kernels of a wheel")
    parser.add_argument("--here", action="store_true", help="run the jobs in this process")
    parser.add_argument("--locks", type=Path, help="with --here: folder of the kernels that are being compiled")
    parser.add_argument("--copy-to", type=Path, help="with --here: copy what they called into this folder")
    given = parser.parse_args()
    names = tuple(given.run or JOBS)
    if given.here:
        if given.locks:
            take_turns(given.locks)
        for name in names:
            run(name)
        if given.copy_to:
            copy_called(given.copy_to)
        return 0
    if given.into is None:
        return spawn_all(names, given.jobs, os.environ)
    return compile_into(given.into, names, given.jobs)


def compile_into(folder: Path, names: tuple[str, ...], jobs: int) -> int:
    """All kernels for a portable processor; what is compiled is kept in `build/` until a source changes."""
    sys.path.insert(0, str(PROJECT))
    from spplanes._jit import PORTABLE

    processor = {"NUMBA_CPU_NAME": PORTABLE.name, "NUMBA_CPU_FEATURES": PORTABLE.features}
    kept = PROJECT / "build" / "kernels" / digest_of_sources()
    environment = {**os.environ, **processor, "NUMBA_CACHE_DIR": str(kept)}
    code = spawn_all(names, jobs, environment)
    if code:
        return code
    words = ["--here", *(f"--run={name}" for name in names), f"--copy-to={folder}"]
    return subprocess.run([sys.executable, __file__, *words], env=with_path(environment), check=False).returncode


def digest_of_sources() -> str:
    """Of all modules: numba looks at a kernel's own module alone, not at those it calls into."""
    state = hashlib.sha256()
    for path in sorted(one for package in PACKAGES for one in (PROJECT / package).rglob("*.py")):
        state.update(path.read_bytes())
    return state.hexdigest()[:16]


def with_path(environment: dict[str, str] | os._Environ[str]) -> dict[str, str]:
    """An environment whose Python finds the packages of this clone, and uses one core."""
    return {**environment, "PYTHONPATH": str(PROJECT), "OMP_NUM_THREADS": "1"}


def spawn_all(names: tuple[str, ...], jobs: int, environment: dict[str, str] | os._Environ[str]) -> int:
    """Run jobs, so many at a time, with a line that says how far they are."""
    start, show = time.perf_counter(), sys.stderr.isatty()
    print(f"compiling the kernels, once ({min(jobs, len(names))} processes) ...", file=sys.stderr)
    with tempfile.TemporaryDirectory() as locks, ThreadPoolExecutor(max(jobs, 1)) as pool:
        words, settings = [sys.executable, __file__, "--here", f"--locks={locks}"], with_path(environment)
        made = {pool.submit(subprocess.run, [*words, f"--run={name}"], env=settings): name for name in names}
        while left := wait(made, timeout=0.1).not_done:
            if show:
                running = ", ".join(name for one, name in made.items() if one.running())
                far = f"{len(made) - len(left)} of {len(made)} done, {time.perf_counter() - start:.0f} s: {running:.50}"
                print(f"\r{far}\033[K", end="", file=sys.stderr)
    print(f"{chr(13) if show else ''}compiled in {time.perf_counter() - start:.0f} s", file=sys.stderr)
    return int(any(one.result().returncode for one in made))


def take_turns(folder: Path) -> None:
    """Let no two processes compile one kernel: who comes second waits, and finds it in the cache.

    Kernels call each other in no circle, so that two processes never wait for each other.
    """
    from numba.core.dispatcher import Dispatcher

    compile_alone = Dispatcher.compile

    def compile_in_turn(self: Any, signature: Any) -> Any:
        function = self.py_func
        if function.__module__.split(".")[0] not in PACKAGES:
            return compile_alone(self, signature)  # numba's own, of which it keeps none
        with (folder / f"{function.__module__}.{function.__qualname__}").open("w") as turn:
            fcntl.flock(turn, fcntl.LOCK_EX)  # let go when the file is closed
            return compile_alone(self, signature)

    Dispatcher.compile = compile_in_turn


def run(name: str) -> None:
    """One job, in silence, in a folder of its own.

    Raises:
        RuntimeError: it failed.
    """
    gc.set_threshold(100_000, 20, 20)  # compiling fills memory with what lives long: looked through less often
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        JOBS[name]()


def copy_called(folder: Path) -> None:
    """The cache files of every kernel that was loaded to be called from Python, a folder for every module.

    Raises:
        RuntimeError: a kernel had to be compiled, which another process should have done.
    """
    from spplanes._jit import KERNELS

    for kernel in KERNELS:
        if kernel._cache_misses:
            raise RuntimeError(f"{kernel.py_func.__module__}.{kernel.py_func.__name__}: expected it in the cache")
        if kernel._cache_hits:
            index = Path(kernel._cache._cache_file._index_path)
            place = folder / kernel.py_func.__module__
            place.mkdir(parents=True, exist_ok=True)
            for file in (index, *index.parent.glob(f"{index.stem}.*.nbc")):
                shutil.copyfile(file, place / file.name)


def command(*words: object) -> None:
    """A command of `spplanes`, in this process, its output thrown away."""
    from slam.cli import main as spplanes

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            spplanes([str(word) for word in words])
        except SystemExit as end:
            if end.code:
                raise RuntimeError(f"spplanes {' '.join(map(str, words))}: {said.getvalue()}") from None


def corridor() -> None:
    """A push-broom robot: simulation, measuring, estimating, pictures; planes first, whose kernels take longest."""
    from spplanes import segment_scans

    segment_scans(three_walls(), sigma=0.004)
    command("demo", "--scans", 60, "--out", "demo")


def plane() -> None:
    """One plane of moments: the smallest of all."""
    import numpy as np

    from spplanes import Moments

    Moments.from_points(np.random.default_rng(0).random((99, 3))).plane()


def pieces() -> None:
    """What a push-broom run calls after its segmentation: begun here while another process compiles that."""
    import numpy as np

    import factors
    from spplanes import MapperConfig, extract_lines, fit_plane
    from spplanes.segmentation.planes import outlines_in

    flat = np.random.default_rng(0).random((200, 3)) * (4.0, 3.0, 0.01)
    covariances, scans = np.tile(np.eye(3) * 1e-4, (200, 1, 1)), np.arange(200) // 20
    joint = np.kron(np.minimum.outer(np.arange(1, 11), np.arange(1, 11)), np.eye(6) * 1e-8)
    plane = fit_plane(flat, covariances, viewpoint=np.zeros(3), scan_index=scans, pose_covariances=joint)
    angles = np.linspace(-1.0, 1.0, 181)
    (line,) = extract_lines(2.0 / np.cos(angles), angles, sigma=0.01)
    grid, labels = np.zeros((40, 60, 3)), np.zeros((40, 60), dtype=np.int64)
    grid[..., 0], grid[..., 1] = np.meshgrid(np.linspace(-3.0, 3.0, 60), np.linspace(-2.0, 2.0, 40))
    labels[10:25, 20:40] = -1  # a window
    outlines_in(np.eye(4)[None], grid, labels, np.array([[1.7, 1.1]]), MapperConfig())
    linearize(factors.plane_factor(plane, 0, 1), factors.line_factor(line, np.eye(4), 0, 1))


def linearize(*made: Any) -> None:
    """Factors of a pose 0 and planes 1 and 2."""
    import gtsam

    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    for key in (1, 2):
        values.insert(key, gtsam.OrientedPlane3(1.0, 0.0, 0.0, float(key)))
    for factor in made:
        factor.linearize(values)


def points() -> None:
    """Planes of clouds: with and without order, of known and of unknown noise."""
    import numpy as np

    from spplanes import Plane, fit_plane

    rng = np.random.default_rng(0)
    flat = rng.random((200, 3)) * (4.0, 3.0, 0.01)
    covariances = np.tile(np.eye(3) * 1e-4, (200, 1, 1))
    plane: Plane = fit_plane(flat, sigma=0.01)
    for method in ("ml", "sp"):
        fit_plane(flat, covariances, method=method)
    scans, shared = np.arange(200) // 20, np.tile(np.eye(6) * 1e-6, (10, 1, 1))
    fit_plane(flat, covariances, scan_index=scans, pose_covariances=shared)
    plane.merge(plane)
    grid = three_walls()
    np.save("grid.npy", grid)
    np.save("heap.npy", rng.permutation(grid.reshape(-1, 3)))
    for cloud in ("grid.npy", "heap.npy"):
        command("fit", cloud, "--out", f"{cloud}.out")
        command("fit", cloud, "--sigma", 0.01)


def three_walls() -> Any:
    """Three walls of a room as a range image, shape (120, 160, 3)."""
    import numpy as np

    u, v = np.meshgrid(np.linspace(-0.7, 0.7, 160), np.linspace(-0.5, 0.5, 120))
    rays = np.stack([np.ones_like(u), u, v], axis=2)
    with np.errstate(divide="ignore"):
        reach = np.minimum(np.minimum(3.0, 1.2 / np.abs(u)), 0.8 / np.abs(v))
    return rays * (reach + 0.004 * np.random.default_rng(0).standard_normal(u.shape))[..., None]


def mapping() -> None:
    """The paper's mapping at given poses, and what is done with a finished run."""
    command("simulate", "corridor", "--scans", 60, "--out", "corridor")
    command("slam", "corridor", "--out", "run", "--batch")
    command("explain", "run", 1)
    command("export", "run", "--to", "planes.ply", "--to", "planes.glb", "--to", "graph.g2o")
    command("import", "run/graph.g2o", "--run", "run", "--out", "again")
    command("map", "corridor", "--rig", "corridor/rig.yaml", "--out", "map")


def spinning() -> None:
    """A robot with a 3D laser, with odometry and without; two of its clouds registered."""
    command("simulate", "hall", "--scans", 6, "--out", "hall")
    command("slam", "hall", "--out", "run")
    clouds = sorted(Path("hall/clouds").iterdir())
    command("register", clouds[0], clouds[1])
    command("slam", "hall/clouds", "--out", "found")


def places() -> None:
    """Two looks at one room compared: by their walls, and by all returns and all free space."""
    import numpy as np

    from slam.frontend.occupancy.raster import Raster
    from slam.registration.correlative_search import PlaceView, search_place
    from slam.registration.place_recognition import Wall, match_constellations

    corners = np.array([(0, 0), (6, 0), (6, 1.5), (7.2, 1.5), (7.2, 2.6), (6, 2.6), (6, 4), (2.2, 4), (2.2, 5), (0, 5)])
    ends = np.stack((corners, np.roll(corners, -1, axis=0)), axis=1) - (3.0, 2.0)
    along = np.diff(ends, axis=1)[:, 0]
    walls = [
        Wall(alpha, float(end[0] @ (np.cos(alpha), np.sin(alpha))), np.eye(2) * 1e-5, end)
        for alpha, end in zip(np.arctan2(-along[:, 0], along[:, 1]).tolist(), ends, strict=True)
    ]
    match_constellations(walls, walls)
    hits = np.concatenate([np.linspace(first, last, 40) for first, last in ends])
    raster, nowhere = Raster.of(np.hstack((np.zeros_like(hits), hits)), 0.5), np.zeros(3)
    reach = np.array((0.3, 0.3, 0.1))
    search_place(PlaceView(raster), PlaceView(raster), nowhere, np.eye(3) * 0.01, reach, looks=9.0)


def rest() -> None:
    """What commands seldom call: clouds without order, packed ones, other factors, pose errors in other fits."""
    import numpy as np

    import factors
    from slam.io.clouds.pcd import lzf_decompress
    from spplanes import fit_plane
    from spplanes.clouds.arrange import arrange

    rng = np.random.default_rng(0)
    heap = rng.standard_normal((2000, 3))
    arrange(heap)
    lzf_decompress(b"\x00a", 1)
    flat, scans = rng.random((200, 3)) * (4.0, 3.0, 0.01), np.arange(200) // 20
    poses = np.tile(np.eye(6) * 1e-6, (10, 1, 1))
    fit_plane(flat, sigma=0.01, method="sp", scan_index=scans, pose_covariances=poses)
    fit_plane(flat, sigma=0.01, robust="tukey", scan_index=scans, pose_covariances=poses)
    linearize(
        factors.direction_prior(1, (1.0, 0.0, 0.0), 0.1, anchor_key=0),
        factors.parallel_factor(1, 2, 0.1),
        factors.perpendicular_factor(1, 2, 0.1),
        factors.distance_factor(1, 2, 1.0, 0.1),
    )


#: The longest first, then what it calls late, compiled by the time it does.
JOBS: dict[str, Callable[[], None]] = {
    job.__name__: job for job in (corridor, pieces, spinning, places, mapping, points, rest, plane)
}

if __name__ == "__main__":
    sys.exit(main())
