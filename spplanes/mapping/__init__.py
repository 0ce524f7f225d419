"""The paper's mapping at known poses, scan after scan."""

from spplanes.mapping.mapper import PlaneMapper

__all__ = ["PlaneMapper"]
