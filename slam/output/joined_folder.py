"""The folder of a joined map: a run's folder, with a trajectory for every mission and joins.json beside."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import gtsam
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from factors.archive import ArchiveError, rekeyed
from slam.evaluation import Metric
from slam.io.g2o.writer import write_g2o
from slam.io.planes_json import write_planes
from slam.io.trajectories import write_tum
from slam.joining import JoinedComponent, JoinedMap
from slam.joining.solution import FLOOR_M, FLOOR_RAD, Place, joint_key
from slam.output.run_files import as_json, write_json, write_result
from slam.runs.history import History
from slam.runs.slam_run import path_length_m
from slam.visualization.pictures import FRAME, WIDTH, draw_planes, save, view_height
from slam.visualization.report import scene_of, write_report


def write_joined(joined: JoinedMap, folder: Path, *, title: str) -> list[Metric]:
    """Write a joined map into a folder that exists; returns its table.

    The largest component is the folder's run; every other one of more than one mission has a folder of its own in it,
    ``component-2`` and so on.
    """
    largest, *others = [one for one in joined.components if len(one.missions) > 1] or joined.components[:1]
    table = _write_component(largest, folder, title, warnings_of(joined))
    for number, component in enumerate(others, start=2):
        (inside := folder / f"component-{number}").mkdir()
        _write_component(component, inside, title, [])
    write_json(folder / "joins.json", joined.to_dict())
    verdicts = [comparison.verdict for comparison in joined.comparisons]
    return [
        *table,
        Metric("pairs compared", len(verdicts), ""),
        Metric("  of them joined", verdicts.count("joined"), ""),
        Metric("components", len(joined.components), ""),
        Metric("missions in the other components", sum(len(one.missions) for one in joined.components[1:]), ""),
        Metric("missions left out", len(joined.left_out), ""),
    ]


def warnings_of(joined: JoinedMap) -> list[str]:
    """What whoever uses the map must know: one sentence each."""
    sentences = [f"{name}: left out: {reason}" for name, reason in joined.left_out.items()]
    sentences += [f"{name}: overlaps with no other mission" for name in joined.alone]
    return sentences + [
        f"{comparison.first} and {comparison.second}: not joined by it: {comparison.reason}"
        for comparison in joined.comparisons
        if comparison.verdict in ("refused", "revoked", "ambiguous")
    ]


def _write_component(component: JoinedComponent, folder: Path, title: str, warnings: Sequence[str]) -> list[Metric]:
    first = component.missions[0]
    rows = [
        Metric("missions", len(component.missions), ""),
        Metric("keyframes", sum(len(one) for one in component.trajectories.values()), ""),
        Metric("path length", sum(path_length_m(one) for one in component.trajectories.values()), "m"),
        Metric("planes in the map", len(component.planes), ""),
        Metric("  of them seen by several missions", sum(len(one) > 1 for one in component.classes), ""),
    ]
    numbers: dict[str, Any] = {"metrics": as_json(rows), "warnings": list(warnings)}
    if first.rig is None:
        raise ValueError(f"{first.mission.name}: expected a mission with its rig, to write a run's folder, got none")
    write_result(component, folder, first.config, first.rig, numbers)
    seen = {number: {"seen_by": missions} for number, missions in component.seen_by.items()}
    write_planes(folder / "planes.json", component.planes, seen)
    (folder / "trajectories").mkdir()
    for name, trajectory in component.trajectories.items():
        write_tum(folder / "trajectories" / f"{name}.tum", trajectory)
    write_g2o(folder / "graph.g2o", *flat_graph(component))
    history = History.of(component.planes)
    history.write(folder / "view.json")
    draw_missions(component, folder / "missions.png")
    pictures = [folder / "missions.png", folder / "map.png"]
    write_report(folder / "report.html", title, [("the map", rows)], pictures, scene_of(component, history))
    return rows


def flat_graph(component: JoinedComponent) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """All factors of all missions over poses in the common frame, planes that are one under one key.

    Where each mission began is in it of the first one alone. What holds poses to the floor stays where the missions are
    on one floor, which is then the same for all: the joint solution leaves them a little room. What is of a type that
    cannot be moved is left out.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    home = {place: places[0] for places in component.classes for place in places}
    for number, mission in enumerate(component.missions):
        own, homes = component.solution.values[number], {}
        base = component.solution.bases[number].matrix()
        level = abs(base[2, 3]) < FLOOR_M and np.abs(base[2, :2]).max() < FLOOR_RAD
        for landmark, (_, key) in mission.graph.planes.items():
            place = home[Place(number, landmark)]
            if place.mission != number:
                keys = component.solution.keys(place)
                homes[key] = keys.plane, keys.anchor
        names = {key: joint_key(number, key) for key in own.keys()}  # noqa: SIM118 - not a mapping
        for key, name in names.items():
            if chr(key >> 56) in "xm":
                values.insert(name, component.solution.pose(number, key))
            elif key not in homes:
                values.insert(name, own.atOrientedPlane3(key))
        for factor in map(mission.graph.factors.at, range(mission.graph.factors.size())):
            if number == 0 or not _speaks_of_its_frame(factor, level):
                with suppress(ArchiveError):
                    graph.push_back(rekeyed(factor, names, homes))
    return graph, values


def _speaks_of_its_frame(factor: gtsam.NonlinearFactor, level: bool) -> bool:
    """Whether a factor would not hold in the common frame: of the start never, of the floor where that is another."""
    is_of_pose = factor.size() == 1 and chr(factor.keys()[0] >> 56) in "xm"
    return isinstance(factor, gtsam.PriorFactorPose3) or (is_of_pose and not level)


def draw_missions(component: JoinedComponent, path: Path) -> None:
    """The map from above, every plane in the colour of the first mission that saw it, with all trajectories."""
    figure = Figure(figsize=(WIDTH, view_height(component, "plan") + FRAME), layout="constrained")
    axes = figure.subplots()
    colours = mpl.colormaps["tab10"](np.arange(10))[:, :3]
    first = [places[0].mission for places in component.classes]
    draw_planes(axes, component.planes, "plan", lambda plane: colours[first[plane.id] % len(colours)])
    for number, (name, trajectory) in enumerate(component.trajectories.items()):
        colour = colours[number % len(colours)]
        axes.plot(*trajectory.poses[:, :2, 3].T, color=colour, lw=1.2, marker=".", ms=3, label=name)
    axes.set_title(f"{len(component.planes)} planes, {len(component.missions)} missions")
    axes.legend(loc="upper right", fontsize=8)
    save(figure, path)
