"""A finished run levelled: its world turned so that the largest floor is level, as an IMU would have had it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.errors import LogError
from slam.floorplan.storeys import plan_axes, upward
from slam.io.trajectories import Trajectory
from slam.runs.stored_run import StoredRun
from spplanes._check import FloatArray


def levelled(run: StoredRun) -> StoredRun:
    """The run in a world whose z is the normal of its largest floor: on that plane z is constant.

    Of all turns about the world's origin it is the one that leaves the heading, by which x keeps its direction in plan:
    (x, y) are those of the floor plan. It is a change of coordinates, exact: covariances of planes and of poses are in
    their own frames and stay what they are. How well the floor's tilt is known is in the floor's own covariance.

    Returns:
        The run with planes, trajectory, odometry and points turned, and the turn (4, 4) as ``moved_by``.

    Raises:
        LogError: no plane of the map is a floor: seen from above, within 30 deg of the world's z.
    """
    up = upward(np.array([one.plane.normal for one in run.planes]).reshape(-1, 3), run.planes)
    if up is None:
        wanted = "expected a floor to level the map by, within 30 deg of the world's z and seen from above"
        raise LogError(run.folder, f"{wanted}, found none of its {len(run.planes)} planes to be one")
    turn = np.eye(4)
    turn[:3, :3] = np.vstack((plan_axes(up).T, up))
    return replace(
        run,
        planes=[replace(one, plane=one.plane.transform(turn)) for one in run.planes],
        trajectory=_turned(run.trajectory, turn),
        odometry=_turned(run.odometry, turn),
        history=replace(run.history, points=run.history.points @ turn[:3, :3].T),
        moved_by=turn if run.moved_by is None else turn @ run.moved_by,
    )


def _turned(trajectory: Trajectory, turn: FloatArray) -> Trajectory:
    return Trajectory(trajectory.stamps_ns, turn @ trajectory.poses)
