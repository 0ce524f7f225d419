"""What a finished run can be exported to, by the ending of the file's name."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from slam.errors import MissingPackageError
from slam.files import whole_file

if TYPE_CHECKING:
    from slam.runs.stored_run import StoredRun


def export_run(run: Path | str, to: Path | str, *, overwrite: bool = False, level: bool = False) -> list[str]:
    """Write one file from the folder of a run; the ending of its name says which.

    ``.ply`` and ``.glb``: the polygons of the planes as a coloured mesh. ``.g2o``: the graph with its planes. ``.tum``,
    and ``.kitti`` or ``.kitti.txt``: the trajectory, every number exactly. ``.dxf``, ``.svg`` and ``.ifc``: the floor
    plan with standard deviations, for which the run's session is replayed. With ``level`` the world is turned so that
    its largest floor is level (`slam.runs.stored_run.levelled`); floor plans always are. Returned is what whoever reads
    the file must know, a sentence each: a floor plan without rooms.

    Raises:
        LogError: a file of the run that is missing or broken; a run at given poses has no graph and no session;
            a map without a floor to ``level`` it by.
        MissingPackageError: a format that needs a package that is not installed.
        ValueError: an ending that is none of these, a file that exists, or a place where nothing can be written.
    """
    run, to = Path(run), Path(to)
    check_target(to, overwrite=overwrite)
    from slam.runs.stored_run import StoredRun, levelled  # after what is refused at once: it takes long to import

    ending, stored = _ending_of(to), StoredRun.read(run)
    if level:
        turned = levelled(stored)
        stored = stored if ending in _PLANS else turned  # these measure the run's own planes once more
    with whole_file(to) as scratch:
        return _write(stored, ending, scratch)


def check_target(to: Path, *, overwrite: bool) -> None:
    """Refuse a name that says no format or one whose package is missing, or a file that exists, before any work."""
    package = _PLANS.get(_ending_of(to))
    if package is not None and find_spec(package) is None:
        raise MissingPackageError(to, package, "bim", doing="writing")
    if not to.parent.is_dir():
        raise ValueError(f"{to}: expected a file in a folder that exists, found no folder {to.parent}")
    if to.exists() and not (overwrite and to.is_file()):
        hint = "give --overwrite to replace it" if to.is_file() else "expected a file to write, got a folder"
        raise ValueError(f"{to}: exists already; {hint}")


#: Endings of floor plans, and the package that each needs.
_PLANS = {".dxf": "ezdxf", ".svg": None, ".ifc": "ifcopenshell"}
_ENDINGS = (".ply", ".glb", ".g2o", ".tum", ".kitti", ".kitti.txt", *_PLANS)


def _ending_of(to: Path) -> str:
    for ending in _ENDINGS:
        if to.name.lower().endswith(ending):
            return ending
    raise ValueError(f"{to}: expected a name that ends in one of {', '.join(_ENDINGS)}")


def _write(run: StoredRun, ending: str, path: Path) -> list[str]:
    from slam.io.trajectories import write_kitti, write_tum

    match ending:
        case ".ply":
            from slam.output.run_files import write_ply
            from slam.visualization.mesh import mesh_of

            write_ply(path, mesh_of(run.planes))
        case ".glb":
            from slam.visualization.mesh import write_glb

            write_glb(path, run.planes)
        case ".g2o":
            _write_graph(run, path)
        case ".tum" if run.moved_by is None:  # turned into matrices and back, the last digit could differ
            shutil.copyfile(run.folder / "trajectory.tum", path)
        case ".tum":
            write_tum(path, run.trajectory)
        case ".kitti" | ".kitti.txt":
            write_kitti(path, run.trajectory.poses)
        case _:
            return _write_floor_plan(run, ending, path)
    return []


def _write_graph(run: StoredRun, path: Path) -> None:
    from slam.io.g2o.reader import read_g2o
    from slam.io.g2o.writer import in_another_world

    source = run.graph_file
    read = read_g2o(source)
    if run.moved_by is None:
        shutil.copyfile(source, path)
    else:
        path.write_text(in_another_world(source, read, run.moved_by), encoding="ascii")


def _write_floor_plan(run: StoredRun, ending: str, path: Path) -> list[str]:
    """Replay the run, measure its map and write the plan with the verdict on it; what to know of the plan."""
    from slam.output.plan_bim import write_dxf, write_ifc
    from slam.output.plan_drawing import write_svg
    from slam.runs.stored_run import stored_floor_plan

    plan = stored_floor_plan(run)
    write = {".dxf": write_dxf, ".svg": write_svg, ".ifc": write_ifc}[ending]
    write(path, plan, None if run.verdict is None else run.verdict.verdict)
    return plan.warnings
