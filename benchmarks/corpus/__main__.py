"""`python -m benchmarks corpus`: run the drives of the corpus and say by kind how good and how honest the runs are."""

import argparse
import json
import resource
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import _page
from benchmarks.corpus.catalogue import Entry, corpus, drawn
from benchmarks.corpus.process import Job, rows_of
from benchmarks.corpus.score import Row
from benchmarks.corpus.summary import by_kind, compared, digits, key

#: Longest that a drive may take, s.
LIMIT_S = 900.0
#: Columns of a row as it is printed when it comes.
_SHOWN = ["drive", "seed", "state", "rmse, m", "worst, m", "sigma, m", "judged", "pose NEES"]
_SHOWN += ["planes", "plane NEES/dof", "duplicates", "verdict", "CPU s"]


def parser_of(name: str, description: str | None) -> argparse.ArgumentParser:
    """The options that corpus and ablation have: which drives, and where their rows and the table go."""
    one = argparse.ArgumentParser(prog=f"python -m benchmarks {name}", description=(description or "").splitlines()[0])
    one.add_argument("--json", type=Path, metavar="FILE", help="write all rows to a file")
    one.add_argument("--write", action="store_true", help="put the table into benchmarks/results.md")
    one.add_argument("--short", action="store_true", help="every kind once")
    one.add_argument("--seeds", type=seeds_of, default=range(1), metavar="A:B", help="seeds from A to B - 1; 0:1")
    one.add_argument("--kind", nargs="+", default=[], metavar="NAME", help="part of a drive's name, pattern, or name")
    one.add_argument("--draw", type=int, metavar="N", help="N random drives out of all combinations, by seed from A on")
    one.add_argument("--limit", type=float, default=LIMIT_S, metavar="S", help="longest that a drive may take, s")
    return one


def seeds_of(word: str) -> range:
    """A:B as a range; A alone is one seed."""
    first, _, end = word.partition(":")
    seeds = range(int(first), int(end) if end else int(first) + 1)
    if not seeds or seeds[0] < 0:
        raise argparse.ArgumentTypeError(f"expected A:B with 0 <= A < B, got {word!r}")
    return seeds


def chosen(asked: argparse.Namespace) -> list[Entry]:
    if asked.draw is not None:
        return drawn(asked.draw, asked.seeds)
    return corpus(asked.seeds, short=asked.short, kinds=asked.kind)


def main(words: Sequence[str]) -> int:
    """Run and print; exit code 2 for options that make no sense."""
    parser = parser_of("corpus", __doc__)
    parser.add_argument("--resume", action="store_true", help="go on with the drives that FILE does not have yet")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="rows of an earlier run: before and after by kind")
    asked = parser.parse_args(words)
    try:
        entries = chosen(asked)
        before = read_rows(asked.compare) if asked.compare else None
        if asked.resume and asked.json is None:
            raise ValueError("--resume: expected --json FILE with it, got none")
        kept = read_rows(asked.json) if asked.resume and asked.json.exists() else []
    except (OSError, ValueError) as error:
        print(f"benchmarks corpus: {error}", file=sys.stderr)
        return 2
    rows = _run(entries, kept, asked)
    lines = by_kind(rows)
    print(f"\n{_page.plain(lines)}\n")
    if before is not None:
        print(f"{_page.plain(compared(before, rows))}\n")
    if asked.write:
        publish("corpus", lines, short=asked.short, seconds=sum(row.get("CPU s", 0.0) for row in rows))
    return 0


def _run(entries: Sequence[Entry], kept: Sequence[Row], asked: argparse.Namespace) -> list[Row]:
    """The rows kept and those of all other drives, on disk as soon as they are there."""
    done, rows = {key(row) for row in kept}, list(kept)
    jobs: list[Job] = [(entry, {}) for entry in entries if (entry.name, entry.seed) not in done]
    for row in printed(rows_of(jobs, asked.limit)):
        rows.append(row)
        if asked.json:
            write_json(asked.json, {"rows": rows})
    return rows


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Results with machine, versions and date."""
    path.write_text(json.dumps({**_page.circumstances(), **content}, default=_page.as_json, indent=1) + "\n")


def publish(name: str, lines: list[Row], *, short: bool, seconds: float) -> None:
    """Put a table among the results kept, and write their page."""
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0  # of the processes that ran the drives
    result = {**_page.circumstances(), "short": short, "rows": lines, "seconds": seconds, "peak_MB": peak_mb}
    _page.PAGE.write_text(_page.page(_page.store({name: json.loads(json.dumps(result, default=_page.as_json))})))


def printed(rows: Iterator[Row]) -> Iterator[Row]:
    """The rows, each on the screen as it comes."""
    for row in rows:
        shown = [name for name in _SHOWN if row.get(name) is not None]
        print(", ".join(f"{name} {digits(row[name])}" for name in shown), flush=True)
        yield row


def read_rows(path: Path) -> list[Row]:
    """Rows that `--json` wrote; a file that holds something else is a ValueError."""
    try:
        return json.loads(path.read_text())["rows"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected rows that --json wrote, got something else") from error
