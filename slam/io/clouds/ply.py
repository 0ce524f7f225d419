"""PLY: reader of the vertices of ascii or binary files of either byte order; writer of tables as binary files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import LogError
from slam.io.clouds.cloud import Cloud, Table, checked, header_lines
from slam.io.raw import check_room, file_size, read_bytes

_WORDS = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
#: What each numpy type is called; files may use numpy's own names, too.
_NAMES = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), _WORDS, strict=True))
_TYPES = {name: kind for kind, short in _NAMES.items() for name in (short, np.dtype(kind).name)}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """A table in a PLY file: vertex, face, ...; where a property is a list, rows differ in length."""

    name: str
    count: int
    columns: list[tuple[str, str]]
    """Name and type of every property, in order."""
    has_lists: bool = False

    def dtype(self, order: str) -> np.dtype:
        """One row of a binary file."""
        return np.dtype([(name, order + kind) for name, kind in self.columns])


def read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file; other elements and properties are left out."""
    vertices, skipped = read_header(path)
    if skipped is None:
        return checked(path, vertices.unpacked(path))
    lines = read_bytes(path, vertices.start).split(b"\n")[skipped : skipped + vertices.count]
    return checked(path, vertices.parsed(path, b"\n".join(lines), "vertices"))


def read_header(path: Path) -> tuple[Table, int | None]:
    """The vertices, and of a text how many lines are before them, None of binary data, which are only weighed."""
    order, elements, start, line = _parse_header(path)
    before = list(takewhile(lambda element: element.name != "vertex", elements))
    if len(before) == len(elements):
        raise LogError(path, "expected an element vertex, found none")
    vertex = elements[len(before)]
    names = [name for name, _ in vertex.columns]
    if len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        raise LogError(path, f"expected the properties x y z once each, got {' '.join(names)[:60]}")
    if any(element.has_lists for element in [*before, vertex]):
        raise LogError(path, "expected vertices before any list, got a list first")
    dtype = vertex.dtype(order)
    skipped = sum(element.count for element in before)
    if order:
        start += sum(element.count * element.dtype(order).itemsize for element in before)
        needed = vertex.count * dtype.itemsize
    else:  # the last line needs no end
        needed = 2 * skipped + 2 * len(names) * vertex.count - 1
    check_room(path, f"{vertex.count} vertices", needed, file_size(path) - start)
    columns = [names.index(axis) for axis in "xyz"]
    vertices = Table(dtype, columns, len(names), vertex.count, start, line if order else line + skipped)
    return vertices, None if order else skipped


def _parse_header(path: Path) -> tuple[str, list[Element], int, int]:
    """Byte order ("" for ascii), elements, where the data begin, and in which line."""
    order: str | None = None
    elements: list[Element] = []
    for number, end, words in header_lines(path):
        if number == 1 and words != ["ply"]:
            raise LogError(path, "expected the word ply at the start of a PLY file", line=1)
        match words:
            case ["end_header"]:
                if order is None:
                    raise LogError(path, "expected the format in the PLY header, found no such line")
                return order, elements, end, number + 1
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(Element(name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].columns.append((name, _TYPES[kind]))
            case _:
                raise LogError(path, f"expected a line of a PLY header, got {' '.join(words)[:40]!r}", line=number)
    raise LogError(path, "expected a PLY header that ends with end_header, found no such line")


def write_ply_tables(path: Path | str, tables: Mapping[str, np.ndarray]) -> None:
    """Write structured arrays as the elements of a binary little-endian PLY file, in their order.

    A field of several numbers a row, such as the corners of a triangle, becomes a list property.
    """
    header, body = ["ply", "format binary_little_endian 1.0"], []
    for name, table in tables.items():
        header.append(f"element {name} {len(table)}")
        columns: list[tuple[Any, ...]] = []
        for field in table.dtype.names or ():
            kind = table.dtype[field]
            base = kind.base.str[1:]
            if kind.shape:
                columns.append((f"{field} size", "u1"))
            columns.append((field, "<" + base, kind.shape))
            header.append(f"property {'list uchar ' if kind.shape else ''}{_NAMES[base]} {field}")
        rows = np.empty(len(table), dtype=columns)
        for field in table.dtype.names or ():
            rows[field] = table[field]
            if table.dtype[field].shape:
                rows[f"{field} size"] = table[field].shape[1]
        body.append(rows.tobytes())
    Path(path).write_bytes("\n".join([*header, "end_header\n"]).encode("ascii") + b"".join(body))
