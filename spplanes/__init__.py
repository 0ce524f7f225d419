"""Planes fitted to uncertain 3D points, with their covariance in the Symmetries and Perturbation model (SPmodel)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spplanes._version import __version__

if TYPE_CHECKING:
    from spplanes.fitting.fit import fit_plane as fit_plane
    from spplanes.fitting.fit import fit_planes as fit_planes
    from spplanes.line import ScanLine as ScanLine
    from spplanes.lines.extraction import LineConfig as LineConfig
    from spplanes.lines.extraction import extract_lines as extract_lines
    from spplanes.mapping.mapper import PlaneMapper as PlaneMapper
    from spplanes.moments import Moments as Moments
    from spplanes.plane import Plane as Plane
    from spplanes.segmentation import MapperConfig as MapperConfig
    from spplanes.segmentation import segment_cloud as segment_cloud
    from spplanes.segmentation import segment_scans as segment_scans
    from spplanes.spmodel import Location as Location

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
__all__ = [*sorted(_HOMES), "__version__"]


def __getattr__(name: str) -> Any:
    # imported when asked for: whoever fits planes must not wait for segmentation, and what it needs of SciPy and GEOS
    if name not in _HOMES:
        raise AttributeError(f"module 'spplanes' has no attribute {name!r}")
    from importlib import import_module

    globals()[name] = found = getattr(import_module(f"spplanes.{_HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
