"""What a finished run can be exported to, by the ending of the file's name."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from slam.errors import LogError
from slam.files import whole_file

if TYPE_CHECKING:
    from slam.runs.stored_run import StoredRun


def export_run(run: Path | str, to: Path | str, *, overwrite: bool = False) -> None:
    """Write one file from the folder of a run; the ending of its name says which.

    ``.ply`` and ``.glb``: the polygons of the planes as a coloured mesh. ``.g2o``: the graph with its planes. ``.tum``,
    and ``.kitti`` or ``.kitti.txt``: the trajectory, every number exactly.

    Raises:
        LogError: a file of the run that is missing or broken; a run at given poses has no graph.
        ValueError: an ending that is none of these, a file that exists, or a place where nothing can be written.
    """
    run, to = Path(run), Path(to)
    check_target(to, overwrite=overwrite)
    from slam.runs.stored_run import StoredRun  # after what is refused at once: it takes long to import

    write = _writer_for(to)
    stored = StoredRun.read(run)
    with whole_file(to, overwrite=overwrite) as scratch:
        write(stored, scratch)


def check_target(to: Path, *, overwrite: bool) -> None:
    """Refuse a name that says no format, or a file that exists, before any work is done for it."""
    _writer_for(to)
    if to.exists() and not (overwrite and to.is_file()):
        hint = "give --overwrite to replace it" if to.is_file() else "expected a file to write, got a folder"
        raise ValueError(f"{to}: exists already; {hint}")


def _writer_for(to: Path) -> Callable[[StoredRun, Path], None]:
    for ending, write in _TARGETS.items():
        if to.name.lower().endswith(ending):
            return write
    raise ValueError(f"{to}: expected a name that ends in one of {', '.join(_TARGETS)}")


def _trajectory(run: StoredRun, path: Path) -> None:
    """The file of the run itself: turned into matrices and back, the last digit could differ."""
    shutil.copyfile(run.folder / "trajectory.tum", path)


def _graph(run: StoredRun, path: Path) -> None:
    source = run.folder / "graph.g2o"
    if not source.is_file():
        raise LogError(source, "expected the graph of a run with poses estimated, found none")
    from slam.io.g2o.reader import read_g2o

    read_g2o(source)
    shutil.copyfile(source, path)


def _mesh(run: StoredRun, path: Path) -> None:
    from slam.output.run_files import write_ply
    from slam.visualization.mesh import mesh_of

    write_ply(path, mesh_of(run.planes))


def _scene(run: StoredRun, path: Path) -> None:
    from slam.visualization.glb import write_glb

    write_glb(path, run.planes)


def _poses(run: StoredRun, path: Path) -> None:
    from slam.io.trajectories import write_kitti

    write_kitti(path, run.trajectory.poses)


_TARGETS: dict[str, Callable[[StoredRun, Path], None]] = {
    ".ply": _mesh,
    ".glb": _scene,
    ".g2o": _graph,
    ".tum": _trajectory,
    ".kitti": _poses,
    ".kitti.txt": _poses,
}
