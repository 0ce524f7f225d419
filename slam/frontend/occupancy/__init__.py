"""Occupancy: what level lasers saw as a raster of walls and free space, and how well points lie in one."""

from slam.frontend.occupancy.raster import (
    CELL_M,
    GAP_STEPS,
    LEAST_GAP_M,
    LEVEL_COSINE,
    MOVABLE_M,
    NOVEL_SHARE,
    Raster,
    beams_of,
    free_standing,
    moved,
    view_from,
)

__all__ = [
    "CELL_M",
    "GAP_STEPS",
    "LEAST_GAP_M",
    "LEVEL_COSINE",
    "MOVABLE_M",
    "NOVEL_SHARE",
    "Raster",
    "beams_of",
    "free_standing",
    "moved",
    "view_from",
]
