"""report.html: the table and the pictures of a run in one file that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from slam.evaluation.metrics import Metric

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }}
table {{ border-collapse: collapse; }}
td, th {{ padding: .2rem .9rem .2rem 0; border-bottom: 1px solid #ddd; text-align: left; }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums; }}
img {{ max-width: 100%; }}
</style></head>
<body><h1>{title}</h1>
{body}
</body></html>
"""


def write_report(
    path: Path, title: str, tables: Sequence[tuple[str, Sequence[Metric]]], pictures: Sequence[Path]
) -> None:
    """Write the page; everything that comes from files is escaped, pictures are embedded."""
    parts = [_table(caption, rows) for caption, rows in tables]
    parts += [_picture(picture) for picture in pictures]
    path.write_text(_PAGE.format(title=escape(title), body="\n".join(parts)), encoding="utf-8")


def format_value(value: float | int | str) -> str:
    """A value for people: floats to five significant digits, whole numbers whole."""
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _table(caption: str, rows: Sequence[Metric]) -> str:
    lines = [
        f'<tr><td>{escape(row.name)}</td><td class="n">{escape(format_value(row.value))}</td>'
        f"<td>{escape(row.unit)}</td></tr>"
        for row in rows
    ]
    head = "<tr><th>metric</th><th>value</th><th>unit</th></tr>"
    return f"<h2>{escape(caption)}</h2>\n<table>{head}{''.join(lines)}</table>"


def _picture(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f'<p><img alt="{escape(path.stem)}" src="data:image/png;base64,{data}"></p>'
