"""view.json: what the pictures of a run need and no other of its files holds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import mapping, shape
from shapely.geometry.base import BaseGeometry

from factors._conventions import POSE3_TO_SP
from slam.errors import LogError
from slam.geometry.frames import evenly
from slam.io.raw import damage_told, read_bytes
from slam.map.map_planes import MapPlane
from slam.planeslam import PlaneSlam, pose_symbol
from spplanes._check import FloatArray, as_shape

FORMAT = "spplanes-view/1"


@dataclass(frozen=True, eq=False)
class History:
    """What happened on the way to a map."""

    seen: dict[int, BaseGeometry] = field(default_factory=dict)
    """All that was seen of a plane, in (x, y) of its frame, where that is more than its outline; by landmark id."""
    kinds: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Factor types that saw a plane, by landmark id."""
    nis: dict[str, list[tuple[int, float, int]]] = field(default_factory=dict)
    """(keyframe, chi2, dof) of every accepted measurement, by factor type."""
    pose_covariances: dict[int, FloatArray] = field(default_factory=dict)
    """Covariance (6, 6) of (x, y, z, phi, theta, psi), along the body's own axes, of some poses, by keyframe."""
    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    """Some returns in the world, to the centimetre, shape (N, 3), m."""

    @classmethod
    def of(cls, planes: Sequence[MapPlane], slam: PlaneSlam | None = None, points: FloatArray | None = None) -> History:
        """The history of a map, of the estimator that made it, and some points (N, 3) to show with it."""
        points = np.empty((0, 3)) if points is None else points.round(2)
        outlines = ((plane, plane.plane.outline) for plane in planes)
        seen = {one.id: one.seen for one, known in outlines if known is None or not one.seen.equals_exact(known, 0.0)}
        kinds = {plane.id: plane.kinds for plane in planes}
        if slam is None:
            return cls(seen, kinds, points=points)
        chosen = evenly(len(slam.keyframes), 60)  # poses over the run: enough to draw, and quick to get
        covariances = {k: slam.marginal_covariance(pose_symbol(k))[np.ix_(POSE3_TO_SP, POSE3_TO_SP)] for k in chosen}
        return cls(seen, kinds, {kind: list(rows) for kind, rows in slam.audit.history.items()}, covariances, points)

    def write(self, path: Path) -> None:
        """Write as JSON; floats survive exactly."""
        document = {
            "format": FORMAT,
            "seen": {str(key): mapping(value) for key, value in self.seen.items()},
            "kinds": {str(key): list(value) for key, value in self.kinds.items()},
            "nis": self.nis,
            "pose_covariances": {str(key): value.tolist() for key, value in self.pose_covariances.items()},
            "points_cm": in_cm(self.points),
        }
        path.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> History:
        """Read what `write` wrote; LogError: the file is something else."""
        with damage_told(path, "expected the view.json of a run, got something else"):
            document = json.loads(read_bytes(path))
            if not isinstance(document, dict) or document.get("format") != FORMAT:
                raise LogError(path, f"expected the format {FORMAT!r}")
            points = np.array(document.get("points_cm", [])).reshape(-1, 3)  # earlier versions kept none
            return cls(
                {int(key): shape(value) for key, value in document["seen"].items()},
                {int(key): tuple(map(str, value)) for key, value in document["kinds"].items()},
                {str(kind): [_row(row) for row in rows] for kind, rows in document["nis"].items()},
                {int(key): as_shape("pose", value, (6, 6)) for key, value in document["pose_covariances"].items()},
                as_shape("points_cm", points, (None, 3)) / 100.0,
            )


def in_cm(points: FloatArray) -> list[int]:
    """Points (N, 3) as whole centimetres, one number after another."""
    return np.rint(100.0 * points).astype(np.int64).ravel().tolist()


def _row(row: Any) -> tuple[int, float, int]:
    keyframe, chi2, dof = row
    if not (int(keyframe) >= 0 and np.isfinite(chi2) and int(dof) > 0):
        raise ValueError("nis: expected (keyframe, chi2, dof)")
    return int(keyframe), float(chi2), int(dof)
