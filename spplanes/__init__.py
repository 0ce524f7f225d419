"""Planes fitted to uncertain 3D points, with their covariance in the Symmetries and Perturbation model (SPmodel)."""

from spplanes._version import __version__
from spplanes.line import ScanLine
from spplanes.lines import LineConfig, extract_lines
from spplanes.plane import Plane

__all__ = ["LineConfig", "Plane", "ScanLine", "__version__", "extract_lines"]
