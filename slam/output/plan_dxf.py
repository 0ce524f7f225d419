"""Floor plans as DXF (R2010, metres): layers by storey, dimensions whose texts carry the standard deviations."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import MissingPackageError
from slam.floorplan import FloorPlan
from slam.output.plan_drawing import Drawing, drawings

#: Layers of a storey: what is on them, AutoCAD's colour index.
LAYERS = {"ROOM": 5, "WALL": 7, "FACE": 8, "OPENING": 3, "DIMENSION": 1, "TEXT": 7}
#: Height of texts, m.
_TEXT_M, _DIMENSION_M = 0.12, 0.08


def write_dxf(path: Path, plan: FloorPlan, verdict: str | None = None) -> None:
    """Write the plan of every storey at the height of its floor, on layers of its own: S0-WALL, S0-ROOM, ...

    WALL has wall solids as closed polylines, less openings; FACE the faces of walls whose other side was not seen;
    ROOM the rooms as closed polylines, holes too; OPENING the openings; DIMENSION and TEXT what was measured.

    Raises:
        MissingPackageError: ezdxf is not installed.
    """
    try:
        from ezdxf import units
        from ezdxf._options import options
        from ezdxf.filemanagement import new
    except ImportError as error:
        raise MissingPackageError(path, "ezdxf", "bim", doing="writing") from error
    fixed = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True  # no time and no random id: equal plans are equal files
    try:
        document = new("R2010", setup=["dimstyles", "linetypes"])
        document.units = units.M
        for number, storey in enumerate(drawings(plan, verdict)):
            _Storey(document, f"S{number}", storey).draw()
        with path.open("w", encoding="utf-8", newline="\n") as stream:
            document.write(stream)
    finally:
        options.write_fixed_meta_data_for_testing = fixed


class _Storey:
    """One storey going into a document."""

    def __init__(self, document: Any, prefix: str, drawing: Drawing) -> None:
        self._space, self._prefix, self._drawing = document.modelspace(), prefix, drawing
        self._z = drawing.elevation
        for name, colour in LAYERS.items():
            document.layers.add(f"{prefix}-{name}", color=colour)
        document.layers.get(f"{prefix}-FACE").dxf.linetype = "DASHED"

    def draw(self) -> None:
        """All of it."""
        one = self._drawing
        for layer, shapes in (("ROOM", one.rooms), ("WALL", one.walls), ("OPENING", [one.openings])):
            for ring in chain.from_iterable(shapes):
                self._closed(layer, ring)
        for a, b in one.faces:
            self._space.add_line((*a, self._z), (*b, self._z), dxfattribs=self._on("FACE"))
        for dimension in one.dimensions:
            self._dimension(dimension.start, dimension.end, dimension.offset, dimension.text)
        for label in one.labels:
            self._text("\\P".join(label.lines), label.place)
        west, _, _, north = one.bounds
        self._text(one.title, np.array([west, north + 1.0]), attachment=7)

    def _on(self, layer: str) -> dict[str, Any]:
        return {"layer": f"{self._prefix}-{layer}"}

    def _closed(self, layer: str, corners: Any) -> None:
        attributes = {**self._on(layer), "elevation": self._z}
        self._space.add_lwpolyline([tuple(xy) for xy in corners], close=True, dxfattribs=attributes)

    def _text(self, text: str, place: Any, attachment: int = 5) -> None:
        attributes = {**self._on("TEXT"), "char_height": _TEXT_M, "attachment_point": attachment}
        self._space.add_mtext(text, dxfattribs={**attributes, "insert": (*place, self._z)})

    def _dimension(self, start: Any, end: Any, offset: float, text: str) -> None:
        override = {"dimtxt": _DIMENSION_M, "dimasz": 0.05, "dimexe": 0.02, "dimexo": 0.02, "dimgap": 0.02, "dimtad": 1}
        made = self._space.add_aligned_dim(
            tuple(start), tuple(end), offset, text=text, dimstyle="EZDXF", override=override,
            dxfattribs=self._on("DIMENSION"),
        )  # fmt: skip
        made.render()
        made.dimension.translate(0.0, 0.0, self._z)
