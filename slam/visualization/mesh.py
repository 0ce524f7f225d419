"""Outlines of map planes as triangles and line segments in the world, and as GLB."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from slam.geometry.frames import lift
from slam.geometry.polygons import polygons_of, segments_of
from slam.map.map_planes import MapPlane
from spplanes._check import FloatArray
from spplanes._version import __version__

#: Colours by what a plane is, RGB in 0..255: floor-like, ceiling-like, walls by the direction they face.
FLOOR_RGB, CEILING_RGB = (150, 150, 150), (205, 205, 215)
WALL_RGB = ((196, 78, 82), (85, 132, 190), (85, 168, 104), (204, 150, 60), (129, 114, 179), (100, 181, 205))
_LEVEL_COSINE = np.cos(np.deg2rad(30.0))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with one colour and one plane each."""

    vertices: FloatArray
    """Corners in the world, shape (V, 3), m."""
    triangles: np.ndarray
    """Indices of corners, counter-clockwise seen from the side the plane was seen from, shape (T, 3), int32."""
    plane_ids: np.ndarray
    """Landmark id of every corner, shape (V,), int32."""
    colours: np.ndarray
    """RGB of every corner, shape (V, 3), uint8."""
    normals: FloatArray
    """Unit normal of the plane of every corner, shape (V, 3)."""


def mesh_of(planes: Sequence[MapPlane]) -> Mesh:
    """Triangulate the polygons of the planes, holes left open."""
    corners = [lift(_triangle_corners(plane), plane.plane.frame) for plane in planes]
    vertices = np.concatenate([np.empty((0, 3)), *corners])
    triangles = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    ids = np.array([plane.id for plane in planes], dtype=np.int32)
    colours = np.array([colour_of(plane) for plane in planes], dtype=np.uint8).reshape(-1, 3)
    normals = np.array([plane.plane.normal for plane in planes]).reshape(-1, 3)
    rows = np.repeat(np.arange(len(planes)), [len(corner) for corner in corners])
    return Mesh(vertices, triangles, ids[rows], colours[rows], normals[rows])


def colour_of(plane: MapPlane) -> tuple[int, int, int]:
    """Grey for floor and ceiling; walls by direction, so that facing and neighbouring walls differ."""
    normal = plane.plane.normal
    if abs(normal[2]) > _LEVEL_COSINE:
        return FLOOR_RGB if normal[2] > 0.0 else CEILING_RGB
    turns = np.arctan2(normal[1], normal[0]) / (2.0 * np.pi)
    return WALL_RGB[round(float(turns) * len(WALL_RGB)) % len(WALL_RGB)]


def _triangle_corners(plane: MapPlane) -> FloatArray:
    """Corners (3 T, 2) of a constrained triangulation of the polygons of a plane."""
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons_of(plane.seen)))
    rings = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)
    return rings[:, :3].reshape(-1, 2)


def rings_of(polygon: shapely.Polygon, frame: FloatArray) -> list[FloatArray]:
    """Rings of a polygon in a plane's frame (4, 4), the outer one first, in the world, (N, 3) each, m."""
    return [lift(shapely.get_coordinates(ring), frame) for ring in (polygon.exterior, *polygon.interiors)]


def chains_of(plane: MapPlane) -> list[FloatArray]:
    """Rings of the polygons of a plane, and the lines where only lines were seen, in the world, (N, 3) each, m."""
    frame = plane.plane.frame
    rings = [ring for part in polygons_of(plane.seen) for ring in rings_of(part, frame)]
    return rings + [lift(chain, frame) for chain in segments_of(plane.seen)]


# Constants of the format, Khronos glTF 2.0 specification, sections 3.6, 4.4 and 5.1.
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT, _UBYTE = 5126, 5125, 5121
_VERTICES, _INDICES = 34962, 34963
#: glTF is y-up, the map z-up: x stays, z becomes y.
_Z_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]


def write_glb(path: Path | str, planes: Sequence[MapPlane]) -> None:
    """Write the polygons of a map, holes left open, coloured and lit from the side they were seen from.

    Every plane is a node "plane ID" whose extras hold normal, d, sigma_m (along the normal at its centre) and
    n_points. glTF has single precision and y up: coordinates are relative to the plane's centre, which is the node's
    translation, and a root node "map" turns z up.
    """
    document, binary = _scene(planes)
    if binary:
        document["buffers"] = [{"byteLength": len(binary)}]
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    body = _chunk(_JSON, text, b" ") + (_chunk(_BIN, binary, b"\0") if binary else b"")
    Path(path).write_bytes(struct.pack("<III", _MAGIC, _VERSION, 12 + len(body)) + body)


def _scene(planes: Sequence[MapPlane]) -> tuple[dict[str, Any], bytes]:
    """The document, and its arrays one after the other; every one is a multiple of four bytes long."""
    nodes: list[dict[str, Any]] = [{"name": "map", "rotation": _Z_UP}]
    meshes, accessors, views, binary = [], [], [], bytearray()

    def add(array: np.ndarray, component: int, kind: str, target: int, **more: Any) -> int:
        """Index of the accessor of an array."""
        data = np.ascontiguousarray(array).tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data), "target": target})
        accessor = {"bufferView": len(accessors), "componentType": component, "count": len(array), "type": kind}
        accessors.append({**accessor, **more})
        binary.extend(data)
        return len(accessors) - 1

    for plane in planes:
        mesh = mesh_of([plane])
        if not len(mesh.triangles):
            continue
        positions = (mesh.vertices - plane.plane.centre).astype("<f4")
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        opaque = np.full((len(positions), 1), 255, dtype=np.uint8)
        attributes = {
            "POSITION": add(positions, _FLOAT, "VEC3", _VERTICES, **bounds),
            "NORMAL": add(mesh.normals.astype("<f4"), _FLOAT, "VEC3", _VERTICES),
            "COLOR_0": add(np.hstack((mesh.colours, opaque)), _UBYTE, "VEC4", _VERTICES, normalized=True),
        }
        indices = add(mesh.triangles.astype("<u4").ravel(), _UINT, "SCALAR", _INDICES)
        node = {"name": f"plane {plane.id}", "mesh": len(meshes), "translation": plane.plane.centre.tolist()}
        primitive = {"attributes": attributes, "indices": indices, "material": 0}
        meshes.append({"name": f"plane {plane.id}", "primitives": [primitive]})
        numbers = {"id": plane.id, "normal": plane.plane.normal.tolist(), "d": plane.plane.d}
        numbers |= {"sigma_m": float(np.sqrt(plane.plane.covariance[0, 0])), "n_points": int(plane.plane.n_points)}
        nodes.append({**node, "extras": numbers})
    asset = {"version": "2.0", "generator": f"spplanes {__version__}"}
    document: dict[str, Any] = {"asset": asset, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes}
    if meshes:
        nodes[0]["children"] = list(range(1, len(nodes)))
        matte = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
        document |= {"meshes": meshes, "materials": [matte], "accessors": accessors, "bufferViews": views}
    return document, bytes(binary)


def _chunk(kind: int, data: bytes, padding: bytes) -> bytes:
    data += padding * (-len(data) % 4)
    return struct.pack("<II", len(data), kind) + data
