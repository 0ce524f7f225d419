"""Folders of scans: clouds, depth images, 3DTK; reading and writing."""
