"""The command that takes a graph back: import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli._job import JsonOption, OutOption, OverwriteOption
from slam.cli._output import show


def import_(
    graph: Annotated[Path, typer.Argument(help="g2o file: the graph.g2o of a run, edited or solved elsewhere.")],
    run: Annotated[Path, typer.Option("--run", help="Folder of the run that it came from.")],
    out: OutOption,
    as_it_is: Annotated[bool, typer.Option("--as-is", help="Take the vertices as they are, without solving.")] = False,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Take an edited GRAPH back: planes.json, mesh and trajectory of the run as the graph has them."""
    from slam.given import check_file_given, check_run_given
    from slam.output.new_folder import check_free, new_folder

    check_free(out, overwrite=overwrite)
    check_run_given(run)
    check_file_given(graph)
    from slam.output.run_files import write_import
    from slam.runs.graph_import import import_graph

    imported = import_graph(graph, run, solve=not as_it_is)
    with new_folder(out, overwrite=overwrite) as folder:
        write_import(imported, folder, run)
    show(f"{graph.name} back into {run.name}", imported.table, as_json)
