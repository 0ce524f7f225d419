"""Simulated missions: a world, a way through it, a robot with its sensors, and the truth about all of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import check_world_given
from slam.files import scratch_folder
from slam.io.carmen import write_carmen
from slam.io.cloud_folders import write_cloud_folder
from slam.sensors.log import LaserScan, Log
from slam.sensors.rig import Rig
from slam.simulation.buildings import LOOPS, corridor, loop_path
from slam.simulation.record import Plan, Truth, record
from slam.simulation.robots import Path as DrivenPath
from slam.simulation.robots import checked_rig, paper_rig, spinning_rig
from spplanes._check import FloatArray, as_positive

#: Scans of the paper's whole corridor, and the way between two of them, m.
PAPER_SCANS, PAPER_SPACING_M = 1083, 0.027
#: Way between two scans of the spinning laser, m.
SPINNING_SPACING_M = 0.5


@dataclass(frozen=True, eq=False)
class ScanArrays:
    """All scans of one 2D laser of a mission as arrays."""

    stamps_ns: np.ndarray
    """Shape (S,), int64."""
    ranges: FloatArray
    """Measured ranges, shape (S, B), m; NaN = no return."""
    angles: FloatArray
    """Bearings, shape (B,), rad."""
    world_T_sensor: FloatArray
    """True poses of the sensor, shape (S, 4, 4)."""
    world_T_body_given: FloatArray
    """Poses of the robot as the log gives them, with the localisation's error, shape (S, 4, 4)."""
    labels: np.ndarray
    """True plane of each beam, shape (S, B), int32; -1: none."""


@dataclass(frozen=True, eq=False)
class Mission:
    """A simulated mission: what the robot recorded, what is known of the robot, and the truth."""

    log: Log
    rig: Rig
    """Sensors, mounts and the noise models the data were drawn from."""
    truth: Truth

    def arrays(self, sensor: str) -> ScanArrays:
        """The scans of one 2D laser as arrays."""
        scans = [scan for scan in self.log.scans(sensor) if isinstance(scan, LaserScan)]
        if not scans:
            raise ValueError(f"sensor: expected a 2D laser of the mission, got {sensor!r}")
        stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
        poses = self.truth.poses_at(stamps)
        given = [p if s.world_T_body is None else s.world_T_body for s, p in zip(scans, poses, strict=True)]
        ranges, world_T_sensor = np.array([s.ranges for s in scans]), poses @ self.rig.sensors[sensor].body_T_sensor
        labels = self.truth.labels[sensor]
        return ScanArrays(stamps, ranges, scans[0].angles, world_T_sensor, np.array(given), labels)

    def save(self, folder: Path | str) -> None:
        """Write log, rig.yaml and truth/ into a folder that is new or empty; all of it or nothing.

        The log is log.clf.gz, or a folder of clouds with times and odometry where the scans are 3D. ValueError: the
        folder holds something, or the mission has 2D and 3D scans, for which there is no format.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"folder: expected a new or an empty folder, got {folder}")
        with scratch_folder(folder) as stage:
            (stage / "truth").mkdir()
            if self.rig.of_kind("cloud"):
                write_cloud_folder(self.log, stage)
            else:
                write_carmen(self.log, self.rig, stage / "log.clf.gz")
            self.rig.to_yaml(stage / "rig.yaml")
            self.truth.write(stage / "truth")
            if folder.exists():
                folder.rmdir()
            os.replace(stage, folder)


def simulate_mission(
    world: str,
    *,
    n_scans: int | None = None,
    seed: int = 0,
    laps: int = 1,
    spacing_m: float | None = None,
    rig: Rig | None = None,
) -> Mission:
    """Drive a robot through a world and record what its sensors read.

    Args:
        world: "corridor" (the paper's), "office" (a ring of 79 m with rooms), "room" (small, for lines): the paper's
            robot; "hall": a robot with a spinning 3D laser.
        n_scans: number of vertical (or 3D) scans; None: the paper's 1083 in the corridor, else all laps.
        seed: of all noise; the world itself is always the same. Equal arguments give equal missions, bit for bit, and
            a shorter mission reads what the longer one read so far.
        laps: times round a world that is a loop.
        spacing_m: way between two vertical (or 3D) scans, m; None: 0.027, or 0.5 for the spinning laser.
        rig: noise, mounts and sweeps other than those of `paper_rig` or `spinning_rig`; sensors keep their names.

    Raises:
        ValueError: an unknown world, fewer than two scans, more than the way holds, no laps, a corridor with laps, a
            rig with a sensor of another name.
    """
    check_world_given(world)
    if laps < 1 or (laps > 1 and world == "corridor"):
        raise ValueError(f"laps: expected 1 in a corridor and at least 1 elsewhere, got {laps}")
    if n_scans is not None and n_scans < 2:
        raise ValueError(f"n_scans: expected at least 2, got {n_scans}")
    step = SPINNING_SPACING_M if world == "hall" else PAPER_SPACING_M
    step = step if spacing_m is None else as_positive("spacing_m", spacing_m)
    robot = checked_rig(rig) if rig is not None else spinning_rig() if world == "hall" else paper_rig()
    if world == "corridor":  # as long as its scans, else as the paper's
        steps = round((PAPER_SCANS - 1) * PAPER_SPACING_M / step) if n_scans is None else n_scans - 1
        plan = Plan(world, corridor(steps * step), DrivenPath.weaving(steps * step), robot, step)
    else:
        plan = Plan(world, LOOPS[world][0](), loop_path(world, laps), robot, step)
    possible = int(plan.path.length_m / step + 1e-9) + 1
    if n_scans is not None and n_scans > possible:
        raise ValueError(f"n_scans: expected at most {possible} for {laps} laps, got {n_scans}")
    log, truth = record(plan, possible if n_scans is None else n_scans, seed)
    return Mission(log, robot, truth)
