"""Commands on a finished run: evaluate, explain, export, view, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from slam.cli._job import JsonOption, OutOption, OverwriteOption
from slam.cli._output import print_json, say, show, visible, warn_of


def evaluate(
    run: Annotated[Path, Argument(help="Folder of a run.")],
    truth: Annotated[Path, Option(help="Simulated mission, TUM trajectory or relations.")],
    truth_of: Annotated[
        str | None, Option(help="Whose poses a TUM truth has: body, sensor, or a sensor's name in the rig.")
    ] = None,
    by_row: Annotated[
        bool, Option("--by-row", help="Poses of a TUM truth are the run's one by one, whatever their times.")
    ] = False,
    clouds: Annotated[
        Path | None, Option(help="Log of RUN: also how sharp its 3D scans are by either trajectory.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score RUN against the truth; the numbers also go into its metrics.json."""
    from slam.errors import check_folder_given, check_truth_given

    check_folder_given(run)
    check_truth_given(truth)
    from slam.evaluation.folders import compare_with_truth, reference_for
    from slam.output.run_files import add_to_metrics

    found = compare_with_truth(run, truth, truth_of=truth_of, by_row=by_row)
    rows = found.rows
    if clouds is not None:
        from slam.evaluation.sharpness import sharpness_of_run

        rows += sharpness_of_run(run, reference_for(run, truth, truth_of=truth_of, by_row=by_row), clouds)
    add_to_metrics(run, "evaluation", rows)
    show(f"{run.name} against {truth.name}", rows, as_json)
    for note in found.notes:
        say(note)


def explain(
    run: Annotated[Path, Argument(help="Folder of a run, finished or not.")],
    keyframe: Annotated[int, Argument(help="Index of the keyframe, from 0.")],
    as_json: Annotated[bool, Option("--json", help="Print decisions and their numbers as JSON.")] = False,
) -> None:
    """Say why each plane and line of a KEYFRAME of RUN was matched, or not, and what the keyframe changed."""
    from slam.session.opening import given_session

    given_session(run)
    from slam.runs.stored_run import explain_keyframe

    found = explain_keyframe(run, keyframe)
    if as_json:
        print_json(found)
        return
    typer.echo(f"keyframe {keyframe} at {found['stamp_s']:.3f} s: {len(found['observations'])} things seen")
    for sentence in found["sentences"]:
        typer.echo(visible(sentence))


def export(
    run: Annotated[Path, Argument(help="Folder of a run.")],
    to: Annotated[
        list[Path],
        Option(
            "--to",
            help="File to write, by its ending: .ply, .glb, .g2o, .tum, .kitti (or .kitti.txt); floor plans with "
            "standard deviations: .dxf, .svg, .ifc.",
        ),
    ],
    level: Annotated[
        bool, Option("--level", help="Turn the world so that the largest floor is level; floor plans always are.")
    ] = False,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Write planes, graph, trajectory or floor plan of RUN as files of other tools; --to may be repeated."""
    from slam.output.export import check_target, export_run
    from slam.session.opening import check_run_given

    for target in to:
        check_target(target, overwrite=overwrite)
    check_run_given(run)
    said: dict[str, None] = {}  # once for all files
    for target in to:
        said.update(dict.fromkeys(export_run(run, target, overwrite=overwrite, level=level)))
    warn_of(list(said))


def view(
    run: Annotated[Path, Argument(help="Folder of a run.")],
    out: Annotated[Path | None, Option(help="Folder for the pictures; default: that of the run.")] = None,
    rerun: Annotated[Path | None, Option(help="Also write a recording for Rerun, FILE.rrd.")] = None,
) -> None:
    """Draw RUN: plan, side view, uncertainty as PNG, and a page to turn and ask the map in a browser."""
    from slam.session.opening import check_run_given

    check_run_given(run)
    from slam.visualization.report import view_run

    for path in view_run(run, out, recording=rerun):
        typer.echo(path)


def import_(
    graph: Annotated[Path, Argument(help="g2o file: the graph.g2o of a run, edited or solved elsewhere.")],
    run: Annotated[Path, Option(help="Folder of the run that it came from.")],
    out: OutOption,
    as_it_is: Annotated[bool, Option("--as-is", help="Take the vertices as they are, without solving.")] = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Take an edited GRAPH back: planes.json, mesh and trajectory of the run as the graph has them."""
    from slam.errors import check_file_given
    from slam.files import check_free, new_folder
    from slam.session.opening import check_run_given

    check_free(out, overwrite=overwrite, reads=(graph, run))
    check_run_given(run)
    check_file_given(graph)
    from slam.output.run_files import write_import
    from slam.runs.graph_import import import_graph

    imported = import_graph(graph, run, solve=not as_it_is)
    with new_folder(out, overwrite=overwrite) as folder:
        write_import(imported, folder, run)
    show(f"{graph.name} back into {run.name}", imported.table, as_json)
