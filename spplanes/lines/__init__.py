"""Lines of 2D lasers, each with its covariance."""

from spplanes.lines.extraction import LineConfig, extract_lines

__all__ = ["LineConfig", "extract_lines"]
