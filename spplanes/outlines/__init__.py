"""Outlines of planar regions: rasters, their rings, polygons with holes."""
