"""The verdict of a finished run: every kind of evidence looked at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam.diagnostics.evidence.coverage import coverage_evidence
from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.evidence.free_space import free_space_evidence
from slam.diagnostics.evidence.innovations import nis_evidence
from slam.diagnostics.evidence.mounts import mount_evidence
from slam.diagnostics.evidence.views import views_of
from slam.diagnostics.verdict import Evidence, Verdict, weigh
from slam.sensors.rig import Rig
from spplanes._check import FloatArray

#: Kinds of statistics there are, which share the significance.
KINDS = 4


def look_at(run: Finished, rig: Rig) -> Verdict:
    """The verdict by everything that is known at the end of a run; reading changes nothing."""
    return weigh(_evidence(run, rig), KINDS)


def _evidence(run: Finished, rig: Rig) -> Iterator[Evidence]:
    yield from coverage_evidence(run)
    if not len(run.keyframes):
        return
    poses, views = run.trajectory.poses, views_of(run.keyframes)
    yield from nis_evidence(run)
    yield from free_space_evidence(run.keyframes, views, poses)
    yield from mount_evidence(run.keyframes, _headings(rig))


def _headings(rig: Rig) -> FloatArray:
    """Places and headings of the 2D lasers' x axes in the body, rows (x, y, heading), shape (N, 3)."""
    mounts = [sensor.body_T_sensor for sensor in rig.of_kind("line").values()]
    rows = [(*mount[:2, 3].tolist(), np.arctan2(mount[1, 0], mount[0, 0])) for mount in mounts]
    return np.array(rows, dtype=float).reshape(-1, 3)
