"""Planes of organised grids of uncertain points: quad filter, clustering, region growing, refinement.

Unless they say otherwise, modules of this package mean by

- points: shape (S, B, 3), m; covariance: of these, (S, B, 1), isotropic variances, or (S, B, 9), m^2;
- labels: region or plane of every point, shape (S, B), int64, -1 = none;
- rows: moments of regions, shape (R, 11); planes: their (normal, d), shape (R, 4); frames: world_T_plane, (R, 4, 4);
- views: viewpoint of every row, shape (S, 3), m; grid: what `Sheet.grid` is.
"""

from spplanes.segmentation.cloud import segment_cloud
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.scans import segment_scans

__all__ = ["MapperConfig", "segment_cloud", "segment_scans"]
