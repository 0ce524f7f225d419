"""A finished run, read back from its folder alone; its map levelled, its floor plan, its keyframes explained."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from factors.association.observations import Observation
from slam.diagnostics.verdict import Verdict
from slam.errors import LogError
from slam.evaluation import Metric
from slam.io.planes_json import read_map
from slam.io.raw import damage_told, read_bytes
from slam.io.trajectories import Trajectory, read_tum
from slam.map.data_association import Decision
from slam.map.map_planes import MapPlane
from slam.planeslam import PlaneSlam
from slam.runs.history import History
from slam.session.opening import SESSION_FILE, check_run_given
from slam.session.store import Session
from spplanes._check import FloatArray

if TYPE_CHECKING:
    from slam.floorplan import FloorPlan


@dataclass(frozen=True, eq=False)
class StoredRun:
    """The files of a run's folder."""

    folder: Path
    planes: list[MapPlane]
    trajectory: Trajectory
    """world_T_body of every keyframe, or the poses that were given."""
    odometry: Trajectory
    """Odometry alone; empty where the run had none."""
    history: History
    """What happened on the way."""
    tables: list[tuple[str, list[Metric]]]
    """The tables of metrics.json, with their captions; the run's own first."""
    verdict: Verdict | None = None
    """What the run said of itself; None where it said nothing: a map made at given poses."""
    moved_by: FloatArray | None = None
    """Rigid motion (4, 4) from the world of the folder's files to the one of these values; None: it is the same."""

    @property
    def graph_file(self) -> Path:
        """Its graph.g2o; LogError: a map at given poses has none."""
        path = self.folder / "graph.g2o"
        if not path.is_file():
            raise LogError(path, "expected the graph of a run with poses estimated, found none")
        return path

    @classmethod
    def read(cls, folder: Path | str) -> StoredRun:
        """Read a run's folder; view.json and odometry.tum may be missing.

        LogError: no folder, or a file of it that is missing or wrong; SessionError: a run that is not finished.
        """
        folder = Path(folder)
        check_run_given(folder)
        history = History.read(folder / "view.json") if (folder / "view.json").exists() else History()
        odometry = read_tum(folder / "odometry.tum") if (folder / "odometry.tum").exists() else Trajectory.empty()
        planes = []
        for stored in read_map(folder / "planes.json"):
            seen = history.seen.get(stored.id, stored.plane.outline or shapely.Polygon())
            kinds = history.kinds.get(stored.id, ())
            planes.append(MapPlane(stored.id, stored.plane, seen, stored.observations, kinds))
        trajectory = read_tum(folder / "trajectory.tum")
        return cls(folder, planes, trajectory, odometry, history, *_numbers(folder / "metrics.json"))


def _numbers(path: Path) -> tuple[list[tuple[str, list[Metric]]], Verdict | None]:
    """Every list of (metric, value, unit) in a metrics.json, and the verdict; none where there is no such file."""
    if not path.exists():
        return [], None
    with damage_told(path, "expected the metrics.json of a run, got something else"):
        document = json.loads(read_bytes(path))
        found = {key: [_metric(row) for row in rows] for key, rows in document.items() if _is_table(rows)}
        tables = [("the run" if key == "metrics" else key, rows) for key, rows in found.items()]
        said = document.get("verdict")
        return tables, None if said is None else Verdict.from_dicts(said, document.get("evidence", []))


def _is_table(rows: Any) -> bool:
    return isinstance(rows, list) and bool(rows) and all(isinstance(row, dict) and "metric" in row for row in rows)


def _metric(row: dict[str, Any]) -> Metric:
    value = row["value"]
    return Metric(str(row["metric"]), float("nan") if value is None else value, str(row["unit"]))


def explain_keyframe(run: Path | str, keyframe: int) -> dict[str, Any]:
    """Replay a run's session, reading only, and explain a keyframe: its time, what became of each thing seen in
    sentences and in numbers, and what the keyframe changed in the map, as for JSON.

    SessionError: no session (runs of `demo` and `map` keep none), or a damaged one; ValueError: no such keyframe.
    """
    with Session.open(run, read_only=True) as session:
        count = len(session)
    if not 0 <= keyframe < count:
        raise ValueError(f"keyframe: expected an index from 0 to {count - 1}, got {keyframe}")
    with PlaneSlam.open(run, read_only=True) as slam:
        frame = slam.keyframes[keyframe]
        return {
            "keyframe": keyframe,
            "stamp_s": frame.stamp_ns * 1e-9,
            "sentences": slam.explain(keyframe),
            "observations": [_as_json(one, frame.observations[one.observation]) for one in slam.decisions[keyframe]],
        }


def _as_json(decision: Decision, seen: Observation) -> dict[str, Any]:
    candidates = [
        {"landmark": one.landmark, "chi2": one.chi2, "dof": one.dof, "p": one.p_value, "confirmed": one.confirmed}
        for one in decision.candidates
    ]
    told = {"observation": decision.observation, "kind": seen.kind, "points": int(seen.n_points)}
    return {**told, "verdict": decision.verdict, "landmark": decision.landmark, "candidates": candidates}


def levelled(run: StoredRun) -> StoredRun:
    """The run in a world whose z is the normal of its largest floor; the turn (4, 4) is its ``moved_by``.

    Of all turns about the world's origin it is the one that leaves the heading, by which x keeps its direction in plan:
    (x, y) are those of the floor plan. It is a change of coordinates, exact: covariances of planes and of poses are in
    their own frames and stay what they are. How well the floor's tilt is known is in the floor's own covariance.
    LogError: no plane of the map is a floor: seen from above, within 30 deg of the world's z.
    """
    from slam.floorplan.storeys import plan_axes, upward  # with what no run needs of scipy

    up = upward(np.array([plane.plane.normal for plane in run.planes]).reshape(-1, 3), run.planes)
    if up is None:
        wanted = "expected a floor to level the map by, within 30 deg of the world's z and seen from above"
        raise LogError(run.folder, f"{wanted}, found none of its {len(run.planes)} planes to be one")
    turn = np.eye(4)
    turn[:3, :3] = np.vstack((plan_axes(up).T, up))
    return replace(
        run,
        planes=[replace(plane, plane=plane.plane.transform(turn)) for plane in run.planes],
        trajectory=_turned(run.trajectory, turn),
        odometry=_turned(run.odometry, turn),
        history=replace(run.history, points=run.history.points @ turn[:3, :3].T),
        moved_by=turn if run.moved_by is None else turn @ run.moved_by,
    )


def _turned(trajectory: Trajectory, turn: FloatArray) -> Trajectory:
    return Trajectory(trajectory.stamps_ns, turn @ trajectory.poses)


def stored_floor_plan(run: StoredRun) -> FloorPlan:
    """Replay the session of a run, reading only, and measure its map.

    LogError: no session (runs of `demo`, `map` and `import` keep none), one that does not lead to the run's planes, or
    a map without a vertical plane; SessionError: a damaged session.
    """
    from slam.floorplan import floor_plan, joint_planes

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
    rows = [np.array([[*plane.plane.normal, plane.plane.d] for plane in planes]) for planes in (first, second)]
    return not first or bool(np.abs(rows[0] - rows[1]).max() < 1e-6)  # rounding, of a batch too
