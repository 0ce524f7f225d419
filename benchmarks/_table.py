"""Rows as text: for the screen and for Markdown."""

from __future__ import annotations

from typing import Any

#: What is in rows for the gate alone: that a time was not taken in turn with the others.
HIDDEN = ("apart",)


def columns_of(rows: list[dict[str, Any]]) -> list[str]:
    """Every name that occurs, in the order in which they first do; not what is for the gate alone."""
    return list(dict.fromkeys(name for row in rows for name in row if name not in HIDDEN))


def cell(value: object) -> str:
    """A value as the tables show it: four digits, nothing where there is nothing."""
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    if isinstance(value, list | tuple):
        return " / ".join(cell(one) for one in value)
    return str(value)


def plain(rows: list[dict[str, Any]]) -> str:
    """Aligned columns."""
    names = columns_of(rows)
    lines = [names, *([cell(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(names))]
    return "\n".join("  ".join(word.ljust(w) for word, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def markdown(rows: list[dict[str, Any]]) -> str:
    """A Markdown table; numbers to the right."""
    names = columns_of(rows)
    numeric = [all(isinstance(row.get(name), int | float | None) for row in rows) for name in names]
    lines = [names, ["---:" if right else "---" for right in numeric]]
    lines += [[cell(row.get(name)).replace("|", "\\|") for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
