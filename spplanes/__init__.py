"""Planes fitted to uncertain 3D points, with their covariance in the Symmetries and Perturbation model (SPmodel)."""

from spplanes._version import __version__
from spplanes.fitting import fit_plane, fit_planes
from spplanes.line import ScanLine
from spplanes.lines import LineConfig, extract_lines
from spplanes.mapping import PlaneMapper
from spplanes.moments import Moments
from spplanes.plane import Plane
from spplanes.segmentation import MapperConfig, segment_scans
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
    "segment_scans",
]
