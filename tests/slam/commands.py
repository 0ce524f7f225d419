"""The command line as a user calls it: what it prints, its exit code, and the one sentence where it refuses."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from slam.cli import main


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    code = command(*arguments)
    return code, *capsys.readouterr()


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one sentence of a command that must end with exit code 2."""
    code, _, err = run(capsys, *arguments)
    assert code == 2, err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1, err
    return err.strip()


def command(*words: object) -> int:
    """Exit code of a command."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(stop.value.code or 0)


def simulated_run(folder: Path, world: str, scans: int, seed: int) -> Path:
    """The folder of a run of a simulated mission, which lies beside it as `mission`."""
    mission, out = folder / "mission", folder / "run"
    assert command("simulate", world, "--out", mission, "--scans", scans, "--seed", seed) == 0
    assert command("slam", mission, "--out", out) == 0
    return out


def values_of(table: list[dict[str, Any]]) -> dict[str, Any]:
    """The values of a table as JSON has it, by the names of their metrics."""
    return {row["metric"].strip(): row["value"] for row in table}


def assert_same_files(folder: Path, other: Path, names: Iterable[str]) -> None:
    """Files of these names have the same bytes in both."""
    assert [name for name in names if (folder / name).read_bytes() != (other / name).read_bytes()] == []
