"""Occupancy: what level lasers saw as a raster of walls and free space, and how well points lie in one."""
