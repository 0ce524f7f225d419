"""The command on one cloud: fit."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli._job import OverwriteOption
from slam.cli._output import visible, warn_of

if TYPE_CHECKING:
    from slam.runs.cloud_fit import FittedCloud


def fit(
    cloud: Annotated[
        Path, typer.Argument(help="Cloud: PCD, PLY, text, KITTI .bin, numpy, LAS, LAZ, E57, depth image.")
    ],
    sigma: Annotated[
        float | None,
        typer.Option("--sigma", help="Standard deviation of the points, m; default: measured."),
    ] = None,
    viewpoint: Annotated[
        tuple[float, float, float], typer.Option("--viewpoint", help="Where a registered cloud was seen from, m.")
    ] = (0.0, 0.0, 0.0),
    min_points: Annotated[int, typer.Option("--min-points", min=3, help="Leave out planes of fewer points.")] = 30,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for planes.json, PLY files and a picture.")] = None,
    overwrite: OverwriteOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the planes as JSON.")] = False,
) -> None:
    """Find the planes of one CLOUD."""
    from slam.output.new_folder import check_free, new_folder
    from slam.preconditions import check_cloud_given

    if sigma is not None and not 0.0 < sigma < 1e3:
        raise ValueError(f"--sigma: expected a standard deviation above 0 in metres, got {sigma}")
    if out is not None:
        check_free(out, overwrite=overwrite)
    check_cloud_given(cloud)
    from slam.io.clouds import read_cloud
    from slam.runs.cloud_fit import fit_cloud

    found = fit_cloud(read_cloud(cloud), cloud, sigma_m=sigma, viewpoint=viewpoint).at_least(min_points)
    if out is not None:
        from slam.output.cloud_files import write_cloud_planes

        with new_folder(out, overwrite=overwrite) as folder:
            write_cloud_planes(found, folder)
    _show(cloud.name, found, as_json)
    warn_of(found.warnings)
    if not found.planes:
        warn_of([f"no planes of {min_points} points or more were found"])


def _show(name: str, found: FittedCloud, as_json: bool) -> None:
    rows = found.table()
    if as_json:
        import json

        noise = {"sigma_m": found.sigma_m, "octave_sigma_m": found.octave_sigma_m, "sigma_note": found.note}
        told = {"points": asdict(found.counts), "planes": rows, "warnings": found.warnings}
        print(json.dumps({**noise, **told}, indent=1))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"{escape(visible(name))}, points of {1000 * found.sigma_m:.3g} mm", title_justify="left")
    headings = ("", "normal", "d\n(m)", "sigma d\n(mm)", "sigma tilt\n(deg)", "points", "area\n(m2)", "")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        normal = " ".join(f"{value:+.3f}" for value in row["normal"])
        numbers = (f"{row['d']:+.3f}", f"{1000 * row['sigma_d_m']:.2g}", f"{row['sigma_tilt_deg']:.2g}")
        table.add_row(str(row["id"]), normal, *numbers, str(row["n_points"]), f"{row['area_m2']:.3g}", row["flag"])
    console = Console()
    console.print(table)
    share, counts = 100.0 * found.share, found.counts
    console.print(f"{len(rows)} planes hold {share:.1f} % of {counts.returns} points; standard deviation {found.note}.")
    console.print(
        f"Of {counts.total} points in the file: {counts.on_planes} on planes, {counts.on_no_plane} on none, "
        f"{counts.edge_on} on planes seen edge-on, {counts.no_return} without a return, {counts.repeated} repeated."
    )
