"""Planes fitted to uncertain 3D points, with their covariance in the Symmetries and Perturbation model (SPmodel)."""

from spplanes._version import __version__
from spplanes.line import ScanLine
from spplanes.plane import Plane

__all__ = ["Plane", "ScanLine", "__version__"]
