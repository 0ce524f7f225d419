"""What every command prints: progress, tables, warnings."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from slam.diagnostics.verdict import Verdict
    from slam.evaluation import Metric
    from slam.timing import StageClock

#: Whether nothing is printed but results, warnings and errors.
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, where stderr is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    hidden = not console.is_terminal or _QUIET.get()
    with Progress(*columns, console=console, transient=True, disable=hidden) as bars:
        task = bars.add_task(name, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def show(title: str, rows: Sequence[Metric], as_json: bool) -> None:
    """Print a table of metric, value, unit; or the same as JSON."""
    if as_json:
        from slam.output.run_files import as_json as rows_as_json

        print_json(rows_as_json(rows))
        return
    from slam.visualization.report import format_value

    words = [(row.name, format_value(row.value), row.unit) for row in rows]
    print_table(title, ("metric", "value", "unit"), words, left=("metric", "unit"))


def print_json(data: object) -> None:
    """Plain numbers, strings, lists and dictionaries on stdout."""
    print(json.dumps(data, indent=1))


def print_table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], *, left: Sequence[str] = (), wrap: bool = True
) -> None:
    """A table on stdout: words of the columns whose headings are `left` to the left, of others to the right."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(visible(title)), title_justify="left")
    for heading in headings:
        table.add_column(heading, justify="left" if heading in left else "right", no_wrap=not wrap)
    for row in rows:
        table.add_row(*(escape(visible(word)) for word in row))
    Console().print(table)


def visible(text: object) -> str:
    """Text in which nothing steers a terminal: names in files may hold escape sequences, or turn the reading round."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in str(text))


def be_quiet(quiet: bool) -> None:
    """Print nothing but results, warnings and errors from here on, or everything again.

    Where stderr is a terminal that includes why the first command ever seems to do nothing (`spplanes._jit`).
    """
    _QUIET.set(quiet)
    if sys.stderr.isatty() and not quiet:
        logging.getLogger("spplanes._jit").setLevel(logging.INFO)


def say(text: object) -> None:
    """One line on stderr, unless it is to be quiet."""
    if not _QUIET.get():
        typer.echo(visible(text), err=True)


def warn_of(sentences: Sequence[str]) -> None:
    """One line each on stderr."""
    for sentence in sentences:
        typer.echo(visible(f"warning: {sentence}"), err=True)


def show_result(
    title: str, rows: Sequence[Metric], clock: StageClock, folder: Path, *, as_json: bool, timings: bool
) -> None:
    """The table of a run, how long it took and with what (in one line, or as rows), and where its results are."""
    from slam.evaluation import Metric
    from slam.output.run_metrics import timings_of

    took_s = clock.elapsed_s
    stages = {**clock.seconds, "imports and the rest": took_s - sum(clock.seconds.values())}
    times = [*timings_of(stages), Metric("time, the whole run", took_s, "s")]
    show(title, [*rows, *(times if timings or as_json else [])], as_json)
    if not timings:
        longest = sorted(stages.items(), key=lambda one: -one[1])[:3]
        most = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in longest)
        say(f"took {took_s:.1f} s, most of it: {most} (--timings for all)")
    page = folder / "report.html"
    say(f"results: {folder}" + (f", the page: {page}" if page.exists() else ""))


def say_verdict(verdict: Verdict, *, strict: bool = False) -> None:
    """The last line of a run, on stderr; with `strict` a broken map ends the command with code 1."""
    typer.echo(visible(verdict.line), err=True)  # a result: quiet does not hide it
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
