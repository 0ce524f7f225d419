"""The verdict of a finished run: every kind of evidence looked at once."""

from __future__ import annotations

from collections.abc import Iterator

from slam.diagnostics.evidence.coverage import (
    ambiguity_evidence,
    assumption_evidence,
    coverage_evidence,
    unmatched_evidence,
    waiting_evidence,
)
from slam.diagnostics.evidence.innovations import believed_evidence, nis_evidence, odometry_evidence
from slam.diagnostics.evidence.mounts import heading_evidence, mount_evidence, turn_evidence
from slam.diagnostics.evidence.prior import prior_evidence
from slam.diagnostics.evidence.surfaces import Surfaces, doubled_evidence, free_space_evidence
from slam.diagnostics.verdict import Evidence, Verdict, weigh
from slam.diagnostics.views import scan_views_of, views_of
from slam.planeslam import PlaneSlam
from slam.sensors.rig import Rig


def assess_run(run: PlaneSlam, rig: Rig) -> Verdict:
    """The verdict by everything that is known at the end of a run; reading changes nothing."""
    return weigh(_evidence(run, rig), kinds=11)


def _evidence(run: PlaneSlam, rig: Rig) -> Iterator[Evidence]:
    yield from coverage_evidence(run)
    if not len(run.keyframes):
        return
    poses, views = run.trajectory.poses, views_of(run.keyframes)
    yield from assumption_evidence(run)
    yield from ambiguity_evidence(run)
    yield from waiting_evidence(run)
    yield from nis_evidence(run)
    yield from odometry_evidence(run, rig)
    yield from believed_evidence(run)
    yield from unmatched_evidence(run)
    yield from free_space_evidence(views, poses)
    yield from free_space_evidence(scan_views_of(run.keyframes, poses), poses)
    yield from mount_evidence(run.keyframes, rig)
    yield from heading_evidence(run.keyframes, poses, rig)
    yield from turn_evidence(run.keyframes, run.trajectory, rig)
    surfaces = Surfaces.of(run)
    yield from doubled_evidence(run, surfaces)
    if run.prior is not None:
        yield from prior_evidence(run, rig, views, surfaces)
