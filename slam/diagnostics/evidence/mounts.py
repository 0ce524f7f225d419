"""Evidence: another mount of the level lasers would fit their scans to the odometry, and the stated one does not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from slam.diagnostics.evidence.views import View, compare
from slam.diagnostics.verdict import Evidence, named
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from spplanes._check import FloatArray

#: Mounts that are easily taken for another: turned about the laser's own axis, upside down, or both.
_TURNS_DEG = (0.0, 90.0, 180.0, -90.0)
_NAMES = {
    (180.0, False): "mounted backwards (yaw 180 deg from what the rig says)",
    (90.0, False): "turned to the left (yaw +90 deg from what the rig says)",
    (-90.0, False): "turned to the right (yaw -90 deg from what the rig says)",
    (0.0, True): "mounted upside down (roll 180 deg from what the rig says)",
    (180.0, True): "mounted upside down and backwards (pitch 180 deg from what the rig says)",
    (90.0, True): "mounted upside down and turned by +90 deg",
    (-90.0, True): "mounted upside down and turned by -90 deg",
}
#: Pairs of keyframes that are compared under every mount, evenly over the run.
_MOST_PAIRS = 100
#: A mount explains the scans if it turns so much of what is seen through under the stated one into what is confirmed.
_EXPLAINS = 0.5


def mount_evidence(keyframes: Sequence[Keyframe], headings: FloatArray) -> Iterator[Evidence]:
    """What the scans say of successive keyframes placed by odometry, under the stated mount and under others.

    Of each pair of neighbours a look at a surface is confirmed or goes through it. Were
    the stated mount right, another would be as often worse as better: a sign test over the pairs, one for each mount.

    Args:
        keyframes: of the run.
        headings: of the level lasers' x axes in the body, as the rig states it, by their places, rows (x, y, heading).
    """
    pairs = _neighbours(keyframes)
    if not pairs:
        return
    stated = np.array([_agreement(keyframes, pair, None, headings) for pair in pairs])
    tests = []
    for mount, name in _NAMES.items():
        under = np.array([_agreement(keyframes, pair, mount, headings) for pair in pairs])
        better, worse = int((under > stated).sum()), int((under < stated).sum())
        if better > worse:
            p_value = len(_NAMES) * float(binomtest(better, better + worse, alternative="greater").pvalue)
            tests.append((float(under.sum()), p_value, better, better + worse, name))
    if not tests:
        return
    _, p_value, better, told, name = max(tests)
    frames = tuple(sorted({one for pair in pairs for one in pair[:2]}))
    yield Evidence(
        "mount",
        "broken",
        min(p_value, 1.0),
        better / told,
        "of pairs",
        frames,
        f"the scans contradict the odometry under the stated mount; a laser {name} would explain {better} of {told} "
        f"pairs of neighbouring scans better ({named(frames)})",
    )


def _neighbours(keyframes: Sequence[Keyframe]) -> list[tuple[int, int, Motion]]:
    """Successive keyframes with returns and odometry between."""
    found = []
    for first, second in pairwise(range(len(keyframes))):
        motion, seen = keyframes[second].motion, (keyframes[first].returns, keyframes[second].returns)
        if motion is not None and all(one is not None and len(one) for one in seen):
            found.append((first, second, motion))
    return found[:: max(1, -(-len(found) // _MOST_PAIRS))]


def _agreement(
    keyframes: Sequence[Keyframe],
    pair: tuple[int, int, Motion],
    mount: tuple[float, bool] | None,
    headings: FloatArray,
) -> float:
    """Looks confirmed less looks through, both ways, of two keyframes under a mount."""
    first, second, motion = pair
    here, there = (View.of(_remounted(keyframes[one].returns, mount, headings)) for one in (first, second))
    back = np.linalg.inv(motion.a_T_b)
    counts = np.add(compare(here, there, motion.a_T_b), compare(there, here, back))
    return float(counts[0] - counts[1])


def _remounted(beams: FloatArray | None, mount: tuple[float, bool] | None, headings: FloatArray) -> FloatArray:
    """Beams (N, 4) as they would be if their lasers were turned, by degrees, and upside down."""
    assert beams is not None
    if mount is None:
        return beams
    turned = beams.copy()
    c, s = np.cos(np.deg2rad(mount[0])), np.sin(np.deg2rad(mount[0]))
    change = np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if mount[1] else 1.0])
    nearest = np.linalg.norm(beams[:, None, :2] - headings[None, :, :2], axis=2).argmin(axis=1)
    for number, (_, _, heading) in enumerate(headings):
        rows = nearest == number
        axes = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        turned[rows, 2:] = beams[rows, :2] + (beams[rows, 2:] - beams[rows, :2]) @ (axes @ change @ axes.T).T
    return turned
