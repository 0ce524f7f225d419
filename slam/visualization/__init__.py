"""Visualization: pictures, pages, meshes, Open3D and Rerun."""
