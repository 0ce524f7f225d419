"""The floor plan of a finished run: its session replayed, for the joint covariance that no file of it holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.errors import LogError
from slam.floorplan import FloorPlan, floor_plan, joint_planes
from slam.map.map_planes import MapPlane
from slam.planeslam import PlaneSlam
from slam.runs.stored_run import StoredRun
from slam.session.state import SESSION_FILE

#: Planes replayed and planes of the file are the same when (normal, d) differ by less: rounding, of a batch too.
_SAME = 1e-6


def stored_floor_plan(run: StoredRun) -> FloorPlan:
    """Replay the session of a run, reading only, and measure its map.

    Raises:
        LogError: no session (runs of `demo`, `map` and `import` keep none), one that does not lead to the run's
            planes, or a map without a vertical plane.
        SessionError: a damaged session.
    """
    if not (run.folder / SESSION_FILE).is_file():
        raise LogError(
            run.folder,
            f"expected a run with its {SESSION_FILE}, from which the joint covariance of its planes comes, found none; "
            "runs of `slam` keep one, those of `demo`, `map` and `import` do not",
        )
    with PlaneSlam.open(run.folder, read_only=True) as slam:
        planes = slam.planes
        if not _are_same(planes, run.planes):  # its graph was solved once more at the end
            slam.adopt_batch()
            planes = slam.planes
        if not _are_same(planes, run.planes):
            raise LogError(run.folder, "expected a session that leads to the run's planes.json, got other planes")
        slam.adopt_batch()  # what iSAM2 did not linearise anew, up to its threshold, is worth 0.1 mm
        joint = joint_planes(slam.planes, slam.landmarks, slam.backend)
    try:
        return floor_plan(joint)
    except ValueError as error:
        raise LogError(run.folder, str(error)) from error


def _are_same(first: Sequence[MapPlane], second: Sequence[MapPlane]) -> bool:
    if [one.id for one in first] != [one.id for one in second]:
        return False
    rows = [np.array([[*one.plane.normal, one.plane.d] for one in planes]) for planes in (first, second)]
    return not first or bool(np.abs(rows[0] - rows[1]).max() < _SAME)
