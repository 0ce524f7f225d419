"""The outer loop of the paper: scan after scan joins the planes found so far."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import as_shape
from spplanes.mapping._region_table import RegionTable
from spplanes.mapping._strip import Strip, settle
from spplanes.plane import Plane
from spplanes.segmentation.config import MapperConfig

__all__ = ["MapperConfig", "PlaneMapper"]


class PlaneMapper:
    """Planes of a push-broom laser, or of any sensor that gives its points scan by scan, all poses given.

    Scans are gathered into strips of `config.strip_scans`; each strip is segmented beside the last scans of the one
    before, so that its regions join the planes that reach into it by the same chi2 tests as everywhere. The last scans
    of a strip are settled only with the next one, which sees what follows them. Of settled scans only the last few are
    kept: memory grows with planes. The paper's strips are two scans long; longer ones give cells that determine their
    tilt, which two scans centimetres apart do not.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section IV.
    """

    def __init__(self, config: MapperConfig | None = None) -> None:
        self.config = config or MapperConfig()
        self._table = RegionTable(self.config)
        self._strip: Strip | None = None

    def add_scan(
        self,
        points: ArrayLike,
        covariances: ArrayLike,
        *,
        viewpoint: ArrayLike | None = None,
        pose_covariance: ArrayLike | None = None,
        scan_origin: ArrayLike | None = None,
    ) -> None:
        """Add one scan.

        Args:
            points: shape (B, 3), m, in the map's frame; not finite = no return. B is that of the first scan.
            covariances: covariance of every point, shape (B, 3, 3), m^2.
            viewpoint: position of the sensor, (3,), m: normals point there. All scans have one, or none.
            pose_covariance: (6, 6) of the pose error (x, y, z, phi, theta, psi) that all points of this scan share.
            scan_origin: the point about which that error turns, (3,), m; the map's origin by default.

        Raises:
            ValueError: another number of beams than before, covariances that are not positive semidefinite, a
                viewpoint with some scans and none with others. A scan that is refused leaves no trace.
        """
        scan = as_shape("points", points, (self._strip.n_beams if self._strip else None, 3), finite=False)
        strip = self._strip or Strip(len(scan), self.config)
        strip.append(scan, covariances, viewpoint, pose_covariance, scan_origin)
        self._strip = strip
        if strip.is_full:
            settle(strip, self._table, self.config.strip_scans, self.config)
            strip.advance(self.config.strip_scans)

    @property
    def planes(self) -> list[Plane]:
        """The planes of all scans so far, in the order of their first point, outlines included."""
        return self._finished().planes()

    @property
    def n_points_seen(self) -> int:
        """Number of returns in all scans so far."""
        return self._table.n_seen + (0 if self._strip is None else self._strip.n_open)

    @property
    def n_points_represented(self) -> int:
        """Number of those that belong to a plane."""
        finished = self._finished()
        return int(finished.fit[finished.kept(), 0].sum())

    @property
    def memory_bytes(self) -> int:
        """Size of the map: moments, shared errors and outlines of the planes, and the open strip."""
        return self._table.memory_bytes + (0 if self._strip is None else self._strip.memory_bytes)

    def labels(self) -> np.ndarray:
        """Plane of every point of all scans, shape (S, B) int32, index into `planes`, -1 = none.

        Raises:
            ValueError: the configuration does not keep labels.
        """
        if not self.config.keep_labels:
            raise ValueError("keep_labels: expected a configuration that keeps labels, got keep_labels=False")
        return self._finished().labels(0 if self._strip is None else self._strip.n_beams)

    def _finished(self) -> RegionTable:
        """The table with the open scans settled, in a copy: the next scans may still change them."""
        if self._strip is None or self._strip.n_open_rows == 0:
            return self._table
        table, strip = self._table.copy(), self._strip.copy()
        table.config = self.config.for_rows(strip.n_context + strip.n_open_rows)
        settle(strip, table, strip.n_open_rows, self.config)
        return table
