"""Evidence: another mount of the sensors would fit their scans to the odometry, and the stated one does not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from factors.association.observations import planes_of
from slam.diagnostics.evidence.surfaces import agreement
from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, at_least, named
from slam.diagnostics.views import View, compare
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.sensors.rig import Mount, Rig
from slam.tracking.turns import TURN_SIGNIFICANCE, TurnSearch, sweeps_along
from spplanes._check import FloatArray

#: Mounts that are easily taken for another: the sensor turned about its own axes, roll and yaw, deg.
_TURNS = (
    (0.0, 180.0, "mounted backwards (yaw 180 deg from what the rig says)"),
    (0.0, 90.0, "turned to the left (yaw +90 deg from what the rig says)"),
    (0.0, -90.0, "turned to the right (yaw -90 deg from what the rig says)"),
    (180.0, 0.0, "mounted upside down (roll 180 deg from what the rig says)"),
    (180.0, 180.0, "mounted upside down and backwards (pitch 180 deg from what the rig says)"),
)


def mount_evidence(keyframes: Sequence[Keyframe], rig: Rig) -> Iterator[Evidence]:
    """What the scans say of neighbouring keyframes placed by odometry, under the stated mount and under others.

    Of each pair of neighbours a look at a surface is confirmed or goes through it. Where of any pair, or of
    all, more go through under the stated mount than `NOVEL_SHARE` explains, others are tried: were the stated one
    right, another would be as often worse as better, which is a sign test over the pairs, one for each mount. Mounts
    that the same test does not tell from the best are named beside the first of them: of a drive without turns one
    backwards is one that is upside down as well.
    """
    lasers, clouds = rig.of_kind("line"), rig.of_kind("cloud")
    mounts = [sensor.body_T_sensor for sensor in (lasers or clouds).values()]
    sees = [_has_seen(one, bool(lasers)) for one in keyframes]
    measured = [one.motion is not None and one.motion.is_measured for one in keyframes]
    pairs = [(a, b) for a, b in pairwise(range(len(keyframes))) if measured[b] and sees[a] and sees[b]]
    pairs = pairs[:: max(1, -(-len(pairs) // (60 if lasers else 15)))]
    if not mounts or not pairs:
        return
    of_pair = _laser_counts if lasers else _cloud_counts

    def counts(turn: FloatArray) -> FloatArray:
        return np.array([of_pair(keyframes[a], keyframes[b], turn, mounts) for a, b in pairs])

    yield from _tests(counts, tuple(sorted({one for pair in pairs for one in pair})))


def heading_evidence(keyframes: Sequence[Keyframe], poses: FloatArray, rig: Rig) -> Iterator[Evidence]:
    """A body that goes backwards all along, where nobody measured its motion: poses (N, 4, 4).

    Without odometry a sensor mounted backwards sees nothing that contradicts it, and the path is that of the sensor
    turned about the body. Bodies with a mount that somebody measured go forwards most of their way; one that never does
    is one whose mount is turned, or whose log is played in reverse. Which of these it is nothing tells.
    """
    sensors = (rig.of_kind("line") or rig.of_kind("cloud")).values()
    measured = any(keyframe.motion is not None and keyframe.motion.is_measured for keyframe in keyframes[1:])
    if len(keyframes) < 2 or measured or not any(sensor.body_T_sensor[:3, 3].any() for sensor in sensors):
        return
    steps = (np.linalg.inv(poses[:-1]) @ poses[1:])[:, :3, 3]
    ways = np.linalg.norm(steps, axis=1)
    ahead = np.abs(steps[:, 0]) > 0.5 * ways
    if ways.sum() < 3.0 or 2 * np.count_nonzero(ahead) < len(steps):
        return
    backwards = ahead & (steps[:, 0] < 0.0)
    share = float(ways[backwards].sum() / ways.sum())
    if share < 0.8:
        return
    p_value = float(at_least(np.count_nonzero(backwards), np.count_nonzero(ahead)))
    frames = tuple((np.flatnonzero(backwards) + 1).tolist())
    sentence = (
        f"nobody measured the motion, and the body goes backwards over {100.0 * share:.0f} % of its way "
        f"({named(frames)}): a sensor mounted backwards (yaw 180 deg from what the rig says) would explain it, "
        "or a log played in reverse"
    )
    yield Evidence("mount", "doubtful", p_value, share, "of the way", frames, sentence)


def _tests(counts: Callable[[FloatArray], FloatArray], frames: tuple[int, ...]) -> Iterator[Evidence]:
    """The stated mount against all others, by looks confirmed and through (P, 2) under a turn (4, 4) of the sensor."""
    stated = counts(np.eye(4))
    whole = stated.sum(axis=0)
    by_pair = len(stated) * at_least(stated[:, 1], stated.sum(axis=1), NOVEL_SHARE).min()
    if min(by_pair, at_least(whole[1], whole.sum(), NOVEL_SHARE)) > SIGNIFICANCE:
        return  # the stated mount fits
    tests = []
    for roll_deg, yaw_deg, name in _TURNS:
        under = counts(Mount(rpy_deg=(roll_deg, 0.0, yaw_deg)).as_matrix())
        gain = (under[:, 0] - under[:, 1]) - (stated[:, 0] - stated[:, 1])
        better, told = _better(gain)
        if 2 * better > told:
            tests.append((gain, better, told, name))
    if not tests:
        return
    best = max((gain for gain, *_ in tests), key=lambda gain: float(gain.sum()))
    (_, better, told, name), *others = [test for test in tests if at_least(*_better(best - test[0])) > SIGNIFICANCE]
    sentence = (
        f"a sensor {name} would explain what the stated mount does not: under it {better} of {told} pairs of "
        f"neighbouring scans fit the odometry better ({named(frames)})"
    )
    if others:
        sentence += f"; nothing tells that from one {' or '.join(name for *_, name in others)}"
    p_value = len(_TURNS) * float(at_least(better, told))
    yield Evidence("mount", "broken", min(p_value, 1.0), better / told, "of pairs", frames, sentence)


def _better(gain: FloatArray) -> tuple[int, int]:
    """On how many of pairs (P,) something is gained, and of how many that tell."""
    return int((gain > 0).sum()), int((gain != 0).sum())


def _has_seen(keyframe: Keyframe, by_lasers: bool) -> bool:
    if by_lasers:
        return keyframe.returns is not None and len(keyframe.returns) > 0
    return bool(planes_of(keyframe.observations))


def _motion(keyframe: Keyframe) -> FloatArray:
    """The motion as wheels measured it, also where returns refute them: that is what a wrong mount makes them do."""
    assert keyframe.motion is not None  # a neighbour has one
    refuted = keyframe.motion.refuted_a_T_b
    return keyframe.motion.a_T_b if refuted is None else refuted


def _laser_counts(first: Keyframe, second: Keyframe, turn: FloatArray, mounts: Sequence[FloatArray]) -> FloatArray:
    """Looks confirmed and looks through, both ways, of two keyframes whose level lasers are turned in their mounts."""
    here, there = (View.of(_turned(one.returns, turn, mounts)) for one in (first, second))
    motion = _motion(second)
    return np.add(compare(here, there, motion), compare(there, here, inverse(motion)))


def _turned(beams: FloatArray | None, turn: FloatArray, mounts: Sequence[FloatArray]) -> FloatArray:
    """Beams (N, 4) in the body as they would be if the lasers they start from were turned."""
    assert beams is not None  # `_has_seen`
    places = np.array([mount[:2, 3] for mount in mounts])
    nearest = np.linalg.norm(beams[:, None, :2] - places, axis=2).argmin(axis=1)
    moved = beams.copy()
    for number, mount in enumerate(mounts):
        rows, axes = nearest == number, mount[:2, :2]
        change = axes @ turn[:2, :2] @ np.linalg.inv(axes)
        moved[rows, 2:] = beams[rows, :2] + (beams[rows, 2:] - beams[rows, :2]) @ change.T
    return moved


def _cloud_counts(first: Keyframe, second: Keyframe, turn: FloatArray, mounts: Sequence[FloatArray]) -> FloatArray:
    """The same of planes that a 3D sensor saw."""
    body_T_sensor = mounts[0]
    change, motion = body_T_sensor @ turn @ inverse(body_T_sensor), _motion(second)
    here, there = (
        [replace(plane, frame=change @ plane.frame) for plane in planes_of(one.observations)] for one in (first, second)
    )
    eye = body_T_sensor @ turn
    return np.add(agreement(here, there, motion, eye), agreement(there, here, inverse(motion), eye))


def turn_evidence(keyframes: Sequence[Keyframe], trajectory: Trajectory, rig: Rig) -> Iterator[Evidence]:
    """Clouds of a lidar that turned while it moved, which nobody compensated."""
    sensors = rig.of_kind("cloud")
    if len(sensors) != 1 or len(keyframes) < 3:
        return
    ((name, sensor),) = sensors.items()
    if sensor.sweep_s > 0.0:
        return
    track = sweeps_along(trajectory).track
    search = TurnSearch(sensor, keyframes, track)
    if search.is_suspected(trajectory, track, TURN_SIGNIFICANCE):
        sentence = (
            f"what {name} saw in different directions does not fit together as if it had been seen at once: if it "
            "turned while it moved, state sweep_s in the rig"
        )
        yield Evidence("turns", "doubtful", 0.0, 1.0, "sensors", tuple(range(len(keyframes))), sentence)
