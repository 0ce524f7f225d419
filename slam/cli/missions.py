"""The command that makes data: simulate."""

from __future__ import annotations

from typing import Annotated

import typer

from slam.cli._job import OutOption, OverwriteOption


def simulate(
    world: Annotated[str, typer.Argument(help="World to drive through: corridor, office, room, or hall for 3D scans.")],
    out: OutOption,
    scans: Annotated[
        int | None, typer.Option("--scans", min=2, help="Push-broom or 3D scans; default: the whole way.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all noise.")] = 0,
    laps: Annotated[int, typer.Option("--laps", min=1, help="Times round a world that is a loop.")] = 1,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a simulated mission: log, rig.yaml and the truth."""
    from slam.given import check_world_given
    from slam.output.new_folder import check_free, new_folder

    check_world_given(world)
    check_free(out, overwrite=overwrite)
    from slam.simulation import simulate_mission

    mission = simulate_mission(world, n_scans=scans, seed=seed, laps=laps)
    with new_folder(out, overwrite=overwrite) as folder:
        mission.save(folder)
