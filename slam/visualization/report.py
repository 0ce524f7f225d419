"""report.html: the map in 3D, charts, tables and pictures of a run in one file that needs no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from slam.diagnostics.verdict import Verdict
from slam.evaluation import Metric


def write_report(
    path: Path,
    title: str,
    tables: Sequence[tuple[str, Sequence[Metric]]],
    pictures: Sequence[Path],
    scene: dict[str, Any],
    verdict: Verdict | None = None,
) -> None:
    """Write the page: verdict, map, planes and pictures, charts, and folded below them the tables.

    Everything that comes from files is escaped, pictures and script are embedded.

    Args:
        path: the page.
        title: its heading.
        tables: (caption, rows) each.
        pictures: PNG files.
        scene: what `slam.visualization.scene.scene_of` makes.
        verdict: what the run says of itself, on top; None: nothing.
    """
    parts = [_picture(picture) for picture in pictures]
    parts += ['<div id="charts"></div>', *(_table(caption, rows) for caption, rows in tables)]
    page = Template(_asset("page.html")).substitute(
        title=escape(title),
        style=_asset("viewer.css"),
        verdict="" if verdict is None else _verdict(verdict),
        map=_asset("map.html"),
        body="\n".join(parts),
        scene=_in_script(scene),
        script=_asset("viewer.js"),
    )
    path.write_text(page, encoding="utf-8")


def format_value(value: float | int | str) -> str:
    """A value for people: floats to five significant digits, whole numbers whole."""
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _table(caption: str, rows: Sequence[Metric]) -> str:
    lines = [
        f'<tr><td>{escape(row.name)}</td><td class="n">{escape(format_value(row.value))}</td>'
        f"<td>{escape(row.unit)}</td></tr>"
        for row in rows
    ]
    head = '<tr><th>metric</th><th class="n">value</th><th>unit</th></tr>'
    return f"<details><summary>{escape(caption)}</summary>\n<table>{head}{''.join(lines)}</table></details>"


def _verdict(verdict: Verdict) -> str:
    reasons = "".join(f"<br>{escape(reason)}" for reason in verdict.reasons)
    return f'<p class="verdict {verdict.verdict}"><b>The map is {verdict.verdict}.</b>{reasons}</p>'


def _picture(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f'<h2>{escape(path.stem)}</h2>\n<p><img alt="{escape(path.stem)}" src="data:image/png;base64,{data}"></p>'


def _in_script(scene: dict[str, Any]) -> str:
    """JSON in which no name can end the script element or start a comment: < > & are written as escapes."""
    text = json.dumps(scene, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _asset(name: str) -> str:
    return (files("slam.visualization") / "viewer" / name).read_text(encoding="utf-8")
