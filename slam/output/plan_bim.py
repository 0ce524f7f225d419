"""Floor plans as the extra `bim` writes them: drawings in DXF (R2010), buildings in IFC4, metres.

Texts of dimensions and property sets carry the standard deviations. Equal plans are equal files.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import MissingPackageError
from slam.floorplan import FloorPlan, Quantity
from slam.floorplan.faces import Face
from slam.floorplan.plan import Room, StoreyPlan
from slam.floorplan.walls import Opening, Wall
from slam.output.plan_drawing import Drawing, drawings, room_name
from spplanes._check import FloatArray

#: Layers of a storey: what is on them, AutoCAD's colour index.
LAYERS = {"ROOM": 5, "WALL": 7, "FACE": 8, "OPENING": 3, "DIMENSION": 1, "TEXT": 7}
#: Sizes of dimensions, m.
_DIMENSION = {"dimtxt": 0.08, "dimasz": 0.05, "dimexe": 0.02, "dimexo": 0.02, "dimgap": 0.02, "dimtad": 1}


def write_dxf(path: Path, plan: FloorPlan, verdict: str | None = None) -> None:
    """Write the plan of every storey at the height of its floor, on layers of its own: S0-WALL, S0-ROOM, ...

    WALL has wall solids as closed polylines, less openings; FACE the faces of walls whose other side was not seen;
    ROOM the rooms as closed polylines, holes too; OPENING the openings; DIMENSION and TEXT what was measured.
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
            _draw(document, f"S{number}", storey)
        classes = document.classes
        classes.add_required_classes(document.dxfversion)
        classes.classes = dict(sorted(classes.classes.items()))  # in the order of a set, another in every process
        with path.open("w", encoding="utf-8", newline="\n") as stream:
            document.write(stream)
    finally:
        options.write_fixed_meta_data_for_testing = fixed


def _draw(document: Any, prefix: str, drawing: Drawing) -> None:
    """One storey into a document."""
    space, z = document.modelspace(), drawing.elevation
    for name, colour in LAYERS.items():
        document.layers.add(f"{prefix}-{name}", color=colour)
    document.layers.get(f"{prefix}-FACE").dxf.linetype = "DASHED"

    def on(layer: str, **more: Any) -> dict[str, Any]:
        return {"layer": f"{prefix}-{layer}", **more}

    for layer, shapes in (("ROOM", drawing.rooms), ("WALL", drawing.walls), ("OPENING", [drawing.openings])):
        for ring in chain.from_iterable(shapes):
            space.add_lwpolyline([tuple(xy) for xy in ring], close=True, dxfattribs=on(layer, elevation=z))
    for a, b in drawing.faces:
        space.add_line((*a, z), (*b, z), dxfattribs=on("FACE"))
    look = {"dimstyle": "EZDXF", "override": _DIMENSION, "dxfattribs": on("DIMENSION")}
    for one in drawing.dimensions:
        made = space.add_aligned_dim(tuple(one.start), tuple(one.end), one.offset, text=one.text, **look)
        made.render()
        made.dimension.translate(0.0, 0.0, z)
    texts: list[tuple[str, Any, int]] = [("\\P".join(label.lines), label.place, 5) for label in drawing.labels]
    west, _, _, north = drawing.bounds
    for text, place, attachment in [*texts, (drawing.title, (west, north + 1.0), 7)]:
        where = {"attachment_point": attachment, "insert": (*place, z)}
        space.add_mtext(text, dxfattribs=on("TEXT", char_height=0.12, **where))


#: Property set of what was measured: every value X has its XStandardDeviation beside it, in the same unit.
MEASURED = "SPPlanes_Measured"
_UNITS = {
    "LENGTHUNIT": "METRE",
    "AREAUNIT": "SQUARE_METRE",
    "VOLUMEUNIT": "CUBIC_METRE",
    "PLANEANGLEUNIT": "RADIAN",
}


def write_ifc(path: Path, plan: FloorPlan, verdict: str | None = None) -> None:
    """Write a building of spaces (IfcSpace), walls (IfcWall) and openings (IfcOpeningElement), in metres.

    A wall whose other side was not seen has a surface and no body, and says so in `OtherSideSeen`. MissingPackageError:
    ifcopenshell is not installed.
    """
    try:
        import ifcopenshell
        import ifcopenshell.guid
    except ImportError as error:
        raise MissingPackageError(path, "ifcopenshell", "bim", doing="writing") from error
    building = _Building(ifcopenshell, plan, verdict or "unknown")
    path.write_text(building.text(), encoding="utf-8")


class _Building:
    """An IFC file in the making. Equal plans are equal files: ids are made of what was measured."""

    def __init__(self, ifc: Any, plan: FloorPlan, verdict: str) -> None:
        self._ifc, self._plan, self._verdict = ifc, plan, verdict
        self._file = ifc.file(schema="IFC4")
        self._seed = hashlib.sha256(np.ascontiguousarray(plan.joint.hesse).tobytes()).hexdigest()
        self._origin = self._placed((0.0, 0.0, 0.0))
        self._context = self._new("IfcGeometricRepresentationContext", None, "Model", 3, 1e-6, self._origin, None)

    def text(self) -> str:
        """The file."""
        units = [self._new("IfcSIUnit", None, kind, None, name) for kind, name in _UNITS.items()]
        empty, units = (None,) * 4, self._new("IfcUnitAssignment", units)
        project = self._new("IfcProject", self._id("project"), None, "spplanes", *empty, [self._context], units)
        site = self._spatial("IfcSite", "site", None, (None,) * 5)
        building = self._spatial("IfcBuilding", "building", None, (None,) * 3)
        self._properties(building, {}, {"Verdict": self._new("IfcLabel", self._verdict)})
        self._aggregate(project, [site])
        self._aggregate(site, [building])
        self._aggregate(building, [self._storey(k, storey, building) for k, storey in enumerate(self._plan.storeys)])
        name = self._file.header.file_name
        name.name, name.time_stamp = "building.ifc", "1970-01-01T00:00:00"
        return self._file.to_string()

    def _storey(self, number: int, plan: StoreyPlan, building: Any) -> Any:
        height = 0.0 if plan.elevation is None else plan.elevation.value
        storey = self._spatial("IfcBuildingStorey", f"storey {number}", building, (height,), (0.0, 0.0, height))
        self._properties(storey, {"Elevation": plan.elevation})
        rooms = [self._room(f"storey {number}/{room_name(k)}", room, plan, storey) for k, room in enumerate(plan.rooms)]
        walls = [self._wall(f"storey {number}/wall {k + 1}", one, plan, storey) for k, one in enumerate(plan.walls)]
        hosts = {id(wall): element for wall, element in zip(plan.walls, walls, strict=True)}
        for k, opening in enumerate(plan.openings):
            if opening.wall is not None:
                self._opening(f"storey {number}/opening {k + 1}", opening, plan, hosts[id(opening.wall)], storey)
        faces = [
            self._face(f"storey {number}/face {k + 1}", face, span, plan, storey)
            for k, (face, span) in enumerate(plan.single)
        ]
        self._aggregate(storey, rooms)
        if walls + faces:
            self._relate("IfcRelContainedInSpatialStructure", f"in storey {number}", walls + faces, storey)
        return storey

    def _room(self, name: str, room: Room, plan: StoreyPlan, storey: Any) -> Any:
        height = room.height.value if room.height is not None else _height_over(plan, [room])
        rings = [plan.storey.in_plan(ring) for ring in room.outline]
        body = self._body(rings, 0.0, height)
        space = self._element("IfcSpace", name, storey, body, (None, "ELEMENT", "INTERNAL", None))
        measures = {"NetFloorArea": room.area, "Height": room.height}
        measures |= {f"Width{k + 1}": width.distance for k, width in enumerate(room.widths)}
        self._properties(space, measures | {f"Side{k + 1}Length": one.length for k, one in enumerate(room.sides)})
        self._quantities(space, "Qto_SpaceBaseQuantities", {"NetFloorArea": room.area, "Height": room.height})
        return space

    def _wall(self, name: str, wall: Wall, plan: StoreyPlan, storey: Any) -> Any:
        body = self._body([plan.storey.in_plan(wall.outline)], 0.0, _height_at(plan, wall.front, wall.back))
        element = self._element("IfcWall", name, storey, body, (None, "SOLIDWALL"))
        self._properties(element, {"Thickness": wall.thickness}, {"OtherSideSeen": self._new("IfcBoolean", True)})
        self._quantities(element, "Qto_WallBaseQuantities", {"Width": wall.thickness})
        return element

    def _face(self, name: str, face: Face, span: tuple[float, float], plan: StoreyPlan, storey: Any) -> Any:
        ends, height = plan.storey.in_plan(np.array([face.point(s) for s in span])), _height_at(plan, face)
        corners = [(*ends[0], 0.0), (*ends[1], 0.0), (*ends[1], height), (*ends[0], height)]
        loop = self._new("IfcPolyLoop", [self._point(corner) for corner in corners])
        surface = self._new("IfcFace", [self._new("IfcFaceOuterBound", loop, True)])
        model = self._new("IfcFaceBasedSurfaceModel", [self._new("IfcConnectedFaceSet", [surface])])
        shape = self._new("IfcShapeRepresentation", self._context, "Surface", "SurfaceModel", [model])
        element = self._element("IfcWall", name, storey, shape, (None, "NOTDEFINED"))
        self._properties(element, {}, {"OtherSideSeen": self._new("IfcBoolean", False)})
        return element

    def _opening(self, name: str, opening: Opening, plan: StoreyPlan, wall: Any, storey: Any) -> None:
        low = opening.sill.value if opening.sill is not None else opening.seen_from_m
        high = opening.height.value if opening.height is not None else opening.seen_to_m
        high = _height_at(plan, opening.face) if high is None else high
        outline = plan.storey.in_plan(opening.outline)
        across = (outline[0] - outline[3]) / np.linalg.norm(outline[0] - outline[3])
        through = outline + 0.05 * (outline - outline.mean(axis=0)) @ np.outer(across, across)
        element = self._element("IfcOpeningElement", name, storey, self._body([through], low, high), (None, "OPENING"))
        self._properties(element, {"Width": opening.width, "LintelHeight": opening.height, "SillHeight": opening.sill})
        self._relate("IfcRelVoidsElement", f"{name} in wall", wall, element)

    def _properties(self, owner: Any, measures: Mapping[str, Quantity | None], others: Mapping[str, Any] = {}) -> None:
        """What was measured, each value with its standard deviation; what was not is left out."""
        made = [self._new("IfcPropertySingleValue", name, None, value, None) for name, value in others.items()]
        for name, measure in measures.items():
            if measure is None:
                continue
            kind = "IfcAreaMeasure" if name.endswith("Area") else "IfcLengthMeasure"
            for suffix, value in (("", measure.value), ("StandardDeviation", measure.sigma)):
                told = self._new(kind, float(value))
                made.append(self._new("IfcPropertySingleValue", name + suffix, None, told, None))
        if made:
            identity = self._id(f"{owner.Name} measured")
            self._defines(owner, self._new("IfcPropertySet", identity, None, MEASURED, None, made))

    def _quantities(self, owner: Any, name: str, measures: Mapping[str, Quantity | None]) -> None:
        made = []
        for key, measure in measures.items():
            if measure is not None:
                kind = "IfcQuantityArea" if key.endswith("Area") else "IfcQuantityLength"
                made.append(self._new(kind, key, f"{measure}", None, float(measure.value), None))
        identity = self._id(f"{owner.Name} quantities")
        self._defines(owner, self._new("IfcElementQuantity", identity, None, name, None, None, made))

    def _defines(self, owner: Any, definition: Any) -> None:
        self._relate("IfcRelDefinesByProperties", f"{owner.Name} {definition.Name} defines", [owner], definition)

    def _spatial(
        self, kind: str, name: str, parent: Any, more: tuple[Any, ...], at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> Any:
        placement = self._new("IfcLocalPlacement", parent and parent.ObjectPlacement, self._placed(at))
        return self._new(kind, self._id(name), None, name, None, None, placement, None, None, "ELEMENT", *more)

    def _element(self, kind: str, name: str, storey: Any, shape: Any, more: tuple[Any, ...]) -> Any:
        placement = self._new("IfcLocalPlacement", storey.ObjectPlacement, self._origin)
        product = self._new("IfcProductDefinitionShape", None, None, [shape])
        return self._new(kind, self._id(name), None, name, None, None, placement, product, *more)

    def _body(self, rings: list[FloatArray], low: float, high: float) -> Any:
        """A prism over rings (N, 2) from one height above the floor to another."""
        lines = [self._new("IfcPolyline", [self._point(xy) for xy in (*ring, ring[0])]) for ring in rings]
        if len(lines) == 1:
            profile = self._new("IfcArbitraryClosedProfileDef", "AREA", None, lines[0])
        else:
            profile = self._new("IfcArbitraryProfileDefWithVoids", "AREA", None, lines[0], lines[1:])
        up = self._new("IfcDirection", (0.0, 0.0, 1.0))
        solid = self._new("IfcExtrudedAreaSolid", profile, self._placed((0.0, 0.0, low)), up, float(high - low))
        return self._new("IfcShapeRepresentation", self._context, "Body", "SweptSolid", [solid])

    def _aggregate(self, whole: Any, parts: list[Any]) -> None:
        if parts:
            self._relate("IfcRelAggregates", f"{whole.Name} parts", whole, parts)

    def _relate(self, kind: str, name: str, *ends: Any) -> None:
        self._new(kind, self._id(name), None, None, None, *ends)

    def _placed(self, at: Iterable[float]) -> Any:
        return self._new("IfcAxis2Placement3D", self._point(at), None, None)

    def _point(self, at: Iterable[float]) -> Any:
        return self._new("IfcCartesianPoint", tuple(float(x) for x in at))

    def _id(self, name: str) -> str:
        return self._ifc.guid.compress(uuid.uuid5(uuid.NAMESPACE_OID, f"{self._seed}/{name}").hex)

    def _new(self, kind: str, *values: Any) -> Any:
        return self._file.create_entity(kind, *values)


def _height_at(plan: StoreyPlan, *faces: Face) -> float:
    """Height of the rooms that faces are sides of; of the faces as they were seen where there is none."""
    rooms = [room for room in plan.rooms if any(side.face in faces for side in room.sides)]
    return _height_over(plan, rooms) if rooms else max(face.top for face in faces)


def _height_over(plan: StoreyPlan, rooms: list[Room]) -> float:
    heights = [room.height.value for room in rooms if room.height is not None]
    return max(heights) if heights else max(side.face.top for room in rooms for side in room.sides)
