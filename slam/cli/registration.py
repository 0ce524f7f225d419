"""The command on two clouds: register."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slam.cli._output import visible

if TYPE_CHECKING:
    from slam.runs.cloud_registration import Registration

#: Rivals that are printed, at most, and the probability of the least of them; JSON has all.
_RIVALS, _LEAST_PROBABILITY = 3, 0.01


def register(
    a: Annotated[
        Path, typer.Argument(help="Cloud in whose frame the pose is told; formats as of fit, and 3DTK's .3d.")
    ],
    b: Annotated[Path, typer.Argument(help="Cloud whose pose is looked for.")],
    guess: Annotated[
        str | None,
        typer.Option(
            "--guess", help="Where B may be in A, X,Y,Z,YAW (m, deg) or a file of one pose: looked at, not believed."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print pose and covariance as JSON.")] = False,
) -> None:
    """Find the pose of cloud B in cloud A, with its covariance, its rivals, and whether it can be believed."""
    from slam.preconditions import check_cloud_given

    check_cloud_given(a)
    check_cloud_given(b)
    from slam.runs.cloud_registration import read_guess, register_clouds

    found = register_clouds(a, b, guess=None if guess is None else read_guess(guess))
    _show(f"{b.name} in {a.name}", found, as_json)


def _show(title: str, found: Registration, as_json: bool) -> None:
    numbers = found.to_dict()
    if as_json:
        import json

        print(json.dumps(numbers, indent=1))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(visible(title)), title_justify="left")
    for heading in ("", "value", "sigma", "unit"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, value, sigma in zip("xyz", numbers["xyz_m"], numbers["sigma_xyz_m"], strict=True):
        table.add_row(name, f"{value:.4f}", f"{sigma:.2g}", "m")
    rows = zip(("yaw", "pitch", "roll"), numbers["ypr_deg"], numbers["sigma_ypr_deg"], strict=True)
    for name, value, sigma in rows:
        table.add_row(name, f"{value:.4f}", f"{sigma:.2g}", "deg")
    console = Console()
    console.print(table)
    console.print(
        f"{found.n_planes} planes are in both, as is {100.0 * found.overlap:.0f} % of the surface of the second."
    )
    for sentence in found.open:
        console.print(visible(sentence), markup=False)
    for rival in numbers["rivals"][:_RIVALS]:
        if rival["probability"] >= _LEAST_PROBABILITY:
            console.print(_rival_line(rival), markup=False)
    line = f"the pose is {found.verdict.verdict}" + "".join(f"; {reason}" for reason in found.verdict.reasons)
    console.print(visible(line), markup=False)


def _rival_line(rival: dict[str, Any]) -> str:
    where = ", ".join(f"{value:.2f}" for value in rival["xyz_m"])
    turn = ", ".join(f"{value:.0f}" for value in rival["ypr_deg"])
    return f"or at ({where}) m, ({turn}) deg, with probability {rival['probability']:.2g}"
