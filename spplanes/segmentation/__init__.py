"""Planes of organised grids of uncertain points: quad filter, clustering, region growing, refinement."""

from spplanes.segmentation.cloud import segment_cloud
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.scans import segment_scans

__all__ = ["MapperConfig", "segment_cloud", "segment_scans"]
