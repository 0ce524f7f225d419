"""Clustering: planar cells, agglomerative hierarchical clustering (AHC) and region growing."""
