"""Odometry of a bag: messages of Odometry, else tf from a frame of the world; and which frame is the body."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from slam.errors import LogError
from slam.io.rosbags._frames import BODIES, WORLDS, Frames, is_world
from spplanes._check import FloatArray


@dataclass(eq=False)
class Moves:
    """What a bag tells of frames and how they move."""

    root: str | None = None
    """A frame of the world by somebody's word."""
    frames: Frames = field(default_factory=Frames)
    """Transforms between frames that are none of the world's."""
    by_tf: list[tuple[int, str, str, FloatArray]] = field(default_factory=list)
    """Transforms out of frames of the world: time, parent, child, parent_T_child."""
    odometry: list[tuple[int, str, FloatArray]] = field(default_factory=list)
    """Of Odometry: time, frame of the body, odom_T_child."""

    def add(self, stamp_ns: int, parent: str, child: str, transform: FloatArray) -> None:
        """A transform of tf."""
        if parent == self.root or is_world(parent):
            self.by_tf.append((stamp_ns, parent, child, transform))
        else:
            self.frames.add(parent, child, transform)


def odometry_of(
    path: Path, found: Moves, body: str | None, notes: list[str]
) -> tuple[str | None, list[tuple[int, FloatArray]]]:
    """Frame of the body, and its poses: of Odometry, else of tf from odom (or another frame of the world).

    Args:
        path: the bag, for errors.
        found: what it tells.
        body: frame of the body by somebody's word; None: the child frame of the odometry, else one of the usual names.
        notes: what is to be said is added here.

    Raises:
        LogError: a frame that was named is not there, or moves against the one whose odometry is told.
    """
    child, poses = _told_odometry(path, found, notes)
    if body is None or body == child:
        return child or _usual_body(found.frames), poses
    if child is None:
        if poses or body in found.frames:
            return body, poses
        raise LogError(path, f"--body-frame: expected a frame of tf, got {body}; there are {found.frames.names}")
    child_T_body = found.frames.body_T(child, body)
    if child_T_body is None:
        raise LogError(
            path, f"--body-frame: expected tf from {child}, the frame of the odometry, to {body}, found none"
        )
    return body, [(stamp, pose @ child_T_body) for stamp, pose in poses]


def _told_odometry(path: Path, found: Moves, notes: list[str]) -> tuple[str | None, list[tuple[int, FloatArray]]]:
    """The frame whose poses odometry tells, and those."""
    if found.odometry:
        child = next((child for _, child, _ in found.odometry if child), None)
        return child, [(stamp, pose) for stamp, _, pose in found.odometry]
    parents = dict.fromkeys(["odom", *WORLDS, *sorted({parent for _, parent, _, _ in found.by_tf})])
    for world in parents if found.root is None else [found.root]:
        of_world = [row for row in found.by_tf if row[1] == world and not is_world(row[2])]
        children = Counter(child for _, _, child, _ in of_world)
        if children:
            body = children.most_common(1)[0][0]
            notes.append(f"no Odometry: took tf from {world} to {body}")
            return body, [(stamp, pose) for stamp, _, child, pose in of_world if child == body]
    moving = found.frames.moving_roots
    if found.root is not None:
        there = ", ".join(sorted({*moving, *(parent for _, parent, _, _ in found.by_tf)})) or "none that moves"
        raise LogError(path, f"--odometry-frame: expected tf from {found.root} to a body, found none; it has {there}")
    for root, child in moving.items():
        notes.append(f"tf moves from {root} to {child}; if that is odometry: --odometry-frame {root}")
    return None, []


def _usual_body(frames: Frames) -> str | None:
    return next((frame for frame in BODIES if frame in frames), None)
