"""Geometry: rigid transforms, polygons, extents of planes, a spatial index."""
