"""Geometry: rigid transforms, polygons."""
