"""What every command prints: progress, tables, warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from slam.diagnostics.verdict import Verdict
    from slam.evaluation.metrics import Metric


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, where stderr is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(name, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def show(title: str, rows: Sequence[Metric], as_json: bool) -> None:
    """Print a table of metric, value, unit; or the same as JSON."""
    if as_json:
        import json

        from slam.output.run_files import as_json as rows_as_json

        print(json.dumps(rows_as_json(rows), indent=1))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from slam.visualization.report import format_value

    table = Table(title=escape(visible(title)), title_justify="left")
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for row in rows:
        table.add_row(escape(visible(row.name)), format_value(row.value), row.unit)
    Console().print(table)


def visible(text: object) -> str:
    """Text in which nothing steers a terminal: names in files may hold escape sequences, or turn the reading round."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in str(text))


def say(text: object) -> None:
    """One line on stderr."""
    typer.echo(visible(text), err=True)


def warn_of(sentences: Sequence[str]) -> None:
    """One line each on stderr."""
    for sentence in sentences:
        say(f"warning: {sentence}")


def say_verdict(verdict: Verdict, *, strict: bool = False) -> None:
    """The last line of a run, on stderr; with `strict` a broken map ends the command with code 1."""
    say(verdict.line)
    if strict and verdict.verdict == "broken":
        raise typer.Exit(1)


@contextmanager
def hint_of(folder: Path) -> Iterator[None]:
    """When a run ends early and left a session, say how to go on."""
    try:
        yield
    except BaseException as error:
        from slam.session.store import SessionError

        if (folder / "session.db").exists() and not isinstance(error, SessionError):  # one in use, finished or damaged
            say(f"what was recorded is safe; go on with: spplanes slam --resume {folder}")
        raise
