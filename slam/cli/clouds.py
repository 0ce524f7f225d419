"""The commands on clouds: fit, register."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from slam.cli._job import OverwriteOption
from slam.cli._output import print_json, print_table, visible, warn_of

if TYPE_CHECKING:
    from slam.runs.cloud_fit import FittedCloud
    from slam.runs.cloud_registration import Registration

Place = tuple[float, float, float]


def fit(
    cloud: Annotated[Path, Argument(help="Cloud: PCD, PLY, text, KITTI .bin, numpy, LAS, LAZ, E57, depth image.")],
    sigma: Annotated[float | None, Option(help="Standard deviation of the points, m; default: measured.")] = None,
    viewpoint: Annotated[Place, Option(help="Where a registered cloud was seen from, m.")] = (0.0, 0.0, 0.0),
    min_points: Annotated[int, Option(min=3, help="Leave out planes of fewer points.")] = 30,
    out: Annotated[Path | None, Option(help="Folder for planes.json, PLY files and a picture.")] = None,
    overwrite: OverwriteOption = False,
    as_json: Annotated[bool, Option("--json", help="Print the planes as JSON.")] = False,
) -> None:
    """Find the planes of one CLOUD."""
    from slam.errors import check_cloud_given
    from slam.files import check_free, new_folder

    if sigma is not None and not 0.0 < sigma < 1e3:
        raise ValueError(f"--sigma: expected a standard deviation above 0 in metres, got {sigma}")
    if out is not None:
        check_free(out, overwrite=overwrite, reads=[cloud])
    check_cloud_given(cloud)
    from slam.io.clouds import read_cloud
    from slam.runs.cloud_fit import fit_cloud

    found = fit_cloud(read_cloud(cloud), cloud, sigma_m=sigma, viewpoint=viewpoint).at_least(min_points)
    if out is not None:
        from slam.output.run_files import write_cloud_planes

        with new_folder(out, overwrite=overwrite) as folder:
            write_cloud_planes(found, folder)
    _show_planes(cloud.name, found, as_json)
    warn_of(found.warnings)
    if not found.planes:
        warn_of([f"no planes of {min_points} points or more were found"])


def _show_planes(name: str, found: FittedCloud, as_json: bool) -> None:
    rows = found.table()
    if as_json:
        noise = {"sigma_m": found.sigma_m, "octave_sigma_m": found.octave_sigma_m, "sigma_note": found.note}
        told = {"points": asdict(found.counts), "planes": rows, "warnings": found.warnings}
        print_json({**noise, **told})
        return
    from rich.console import Console

    words = []
    for row in rows:
        normal = " ".join(f"{value:+.3f}" for value in row["normal"])
        numbers = (f"{row['d']:+.3f}", f"{1000 * row['sigma_d_m']:.2g}", f"{row['sigma_tilt_deg']:.2g}")
        words.append((str(row["id"]), normal, *numbers, str(row["n_points"]), f"{row['area_m2']:.3g}", row["flag"]))
    headings = ("", "normal", "d\n(m)", "sigma d\n(mm)", "sigma tilt\n(deg)", "points", "area\n(m2)", "")
    print_table(f"{name}, points of {1000 * found.sigma_m:.3g} mm", headings, words, wrap=False)
    console = Console()
    counts = found.counts
    share = 100.0 * (counts.on_planes / max(counts.returns, 1))
    console.print(f"{len(rows)} planes hold {share:.1f} % of {counts.returns} points; standard deviation {found.note}.")
    console.print(
        f"Of {counts.total} points in the file: {counts.on_planes} on planes, {counts.on_no_plane} on none, "
        f"{counts.edge_on} on planes seen edge-on, {counts.no_return} without a return, {counts.repeated} repeated."
    )


#: Rivals that are printed, at most, and the probability of the least of them; JSON has all.
_RIVALS, _LEAST_PROBABILITY = 3, 0.01


def register(
    a: Annotated[Path, Argument(help="Cloud in whose frame the pose is told; formats as of fit, and 3DTK's .3d.")],
    b: Annotated[Path, Argument(help="Cloud whose pose is looked for.")],
    guess: Annotated[
        str | None,
        Option(help="Where B may be in A, X,Y,Z,YAW (m, deg) or a file of one pose: looked at, not believed."),
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print pose and covariance as JSON.")] = False,
) -> None:
    """Find the pose of cloud B in cloud A, with its covariance, its rivals, and whether it can be believed."""
    from slam.errors import check_cloud_given

    check_cloud_given(a)
    check_cloud_given(b)
    from slam.runs.cloud_registration import read_guess, register_clouds

    found = register_clouds(a, b, guess=None if guess is None else read_guess(guess))
    _show_pose(f"{b.name} in {a.name}", found, as_json)


def _show_pose(title: str, found: Registration, as_json: bool) -> None:
    numbers = found.to_dict()
    if as_json:
        print_json(numbers)
        return
    from rich.console import Console

    words = [
        (name, f"{value:.4f}", f"{sigma:.2g}", unit)
        for names, key, unit in (("x y z", "xyz_m", "m"), ("yaw pitch roll", "ypr_deg", "deg"))
        for name, value, sigma in zip(names.split(), numbers[key], numbers[f"sigma_{key}"], strict=True)
    ]
    print_table(title, ("", "value", "sigma", "unit"), words, left=("", "unit"))
    console = Console()
    console.print(
        f"{found.n_planes} planes are in both, as is {100.0 * found.overlap:.0f} % of the surface of the second."
    )
    if found.bent:
        console.print("Both clouds are bent, as by a lidar that moved while it turned: its pose is that of mid-turn.")
    for sentence in found.open:
        console.print(visible(sentence), markup=False)
    for rival in numbers["rivals"][:_RIVALS]:
        if rival["probability"] >= _LEAST_PROBABILITY:
            where = ", ".join(f"{value:.2f}" for value in rival["xyz_m"])
            turn = ", ".join(f"{value:.0f}" for value in rival["ypr_deg"])
            line = f"or at ({where}) m, ({turn}) deg, with probability {rival['probability']:.2g}"
            console.print(line, markup=False)
    line = f"the pose is {found.verdict.verdict}" + "".join(f"; {reason}" for reason in found.verdict.reasons)
    console.print(visible(line), markup=False)
