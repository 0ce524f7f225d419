"""Probabilistic plane fits: planes and their covariances from points and theirs."""

from spplanes.fitting.fit import fit_plane, fit_planes

__all__ = ["fit_plane", "fit_planes"]
