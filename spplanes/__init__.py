"""Planes fitted to uncertain 3D points, with their covariance in the Symmetries and Perturbation model (SPmodel)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spplanes._version import __version__

if TYPE_CHECKING:
    from spplanes.fitting.fit import fit_plane, fit_planes
    from spplanes.line import ScanLine
    from spplanes.lines.extraction import LineConfig, extract_lines
    from spplanes.mapping.mapper import PlaneMapper
    from spplanes.moments import Moments
    from spplanes.plane import Plane
    from spplanes.segmentation import MapperConfig, segment_cloud, segment_scans
    from spplanes.spmodel import Location

__all__ = [
    "LineConfig",
    "Location",
    "MapperConfig",
    "Moments",
    "Plane",
    "PlaneMapper",
    "ScanLine",
    "__version__",
    "extract_lines",
    "fit_plane",
    "fit_planes",
    "segment_cloud",
    "segment_scans",
]

_HOMES = {
    "LineConfig": "lines",
    "Location": "spmodel",
    "MapperConfig": "segmentation",
    "Moments": "moments",
    "Plane": "plane",
    "PlaneMapper": "mapping",
    "ScanLine": "line",
    "extract_lines": "lines",
    "fit_plane": "fitting",
    "fit_planes": "fitting",
    "segment_cloud": "segmentation",
    "segment_scans": "segmentation",
}


def __getattr__(name: str) -> Any:
    # imported when asked for: whoever fits planes must not wait for segmentation, and what it needs of SciPy and GEOS
    if name not in _HOMES:
        raise AttributeError(f"module 'spplanes' has no attribute {name!r}")
    from importlib import import_module

    globals()[name] = found = getattr(import_module(f"spplanes.{_HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
