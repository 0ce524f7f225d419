"""Proposals wait for others that agree; a closed loop is held against what is seen on the way on."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import pose_prior
from slam.backend.estimator import Backend, pose_symbol
from slam.config import BackendConfig, LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.loop_closure.candidates import DrivenPath
from slam.loop_closure.pairwise_consistency import Proposal
from slam.loop_closure.proposals import Proposals, Trial, evidence_of_map
from slam.loop_closure.verification import Surroundings
from slam.map.landmarks import LandmarkMap
from slam.registration.submaps import PlanarPose
from tests.slam.laser_floors import cast

STEP, FOUND = np.diag((0.01, 0.01, 0.004)) ** 2, np.diag((0.02, 0.02, 0.004)) ** 2
CONFIG = LoopConfig()
ANGLES = np.linspace(-np.pi / 2, np.pi / 2, 181)


def graph_of(poses: list[np.ndarray], covariance: np.ndarray = STEP) -> Backend:
    """Poses (x, y, theta) one after another, tied by odometry that says them exactly."""
    backend, frames = Backend(BackendConfig()), [planar_transform(*pose) for pose in poses]
    factors, values = [pose_prior(pose_symbol(0), frames[0], 1e-6 * np.eye(6))], gtsam.Values()
    for index, frame in enumerate(frames):
        values.insert(pose_symbol(index), gtsam.Pose3(frame))
        if index:
            motion = Motion(inverse(frames[index - 1]) @ frame, covariance, (1e-3, 1e-3, 1e-3))
            factors += motion.factors(pose_symbol(index - 1), pose_symbol(index))
    backend.update(factors, values)
    return backend


#: 20 m out, turned round, and back beside it.
LAP = [np.array((float(x), 0.0, 0.0)) for x in range(21)] + [np.array((20.0 - x, 0.5, np.pi)) for x in range(21)]


def proposal(keyframe: int, old: int, log_odds: float, wrong: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Proposal:
    """What a comparison of two places of the lap proposes, wrong by a motion."""
    old_T_now = inverse(planar_transform(*LAP[old])) @ planar_transform(*LAP[keyframe]) @ planar_transform(*wrong)
    return Proposal(keyframe, old, PlanarPose(planar_delta(old_T_now), FOUND), log_odds, float(keyframe))


def closed(proposals: list[Proposal], held: range = range(42)) -> list[tuple[int, int]]:
    """The ends of the closures that the last of some proposals lets be closed."""
    backend, waiting, group = graph_of(LAP), Proposals(CONFIG), []
    for one in proposals:
        group = waiting.agreed(one, held, backend)
    return sorted((one.keyframe, one.old_keyframe) for one in group)


@pytest.mark.parametrize(
    ("proposals", "ends"),
    [
        pytest.param([proposal(30, 11, 5.0)], [], id="one waits for another"),
        pytest.param([proposal(30, 11, 5.0), proposal(34, 7, 5.0)], [(30, 11), (34, 7)], id="that agrees"),
        pytest.param([proposal(30, 11, 5.0), proposal(31, 10, 5.0)], [], id="hardly moved on"),
        pytest.param([proposal(30, 11, 13.0)], [], id="hardly beyond all doubt"),
        pytest.param([proposal(30, 11, 14.0)], [(30, 11)], id="beyond all doubt"),
        pytest.param([proposal(30, 11, 6.0), proposal(34, 7, 6.0, (1.0, 0.0, 0.0))], [], id="elsewhere"),
        pytest.param([proposal(30, 11, 6.0), proposal(34, 7, 6.0, (0.0, 0.0, 0.3))], [], id="turned"),
    ],
)
def test_which_proposals_are_closed(proposals: list[Proposal], ends: list[tuple[int, int]]):
    assert closed(proposals) == ends


def test_of_many_proposals_those_that_agree_are_closed():
    astray = [proposal(28, 13, 6.0, (2.0, 0.0, 0.0)), proposal(32, 9, 6.0, (-1.5, 0.3, 0.0))]
    right = [proposal(26, 15, 3.0), proposal(33, 8, 3.0), proposal(40, 1, 3.0)]
    assert closed([right[0], astray[0], astray[1], *right[1:]]) == [(26, 15), (33, 8), (40, 1)]


def test_a_proposal_whose_keyframe_left_the_graph_is_forgotten():
    assert closed([proposal(30, 11, 5.0), proposal(34, 7, 5.0)], range(12, 42)) == []


def test_a_loop_is_lost_when_what_contradicts_it_outweighs_what_closed_it():
    trial = Trial(100.0)
    trial.update(900.0, 103.0, CONFIG)  # however well it fits, no witness is surer than 1 / significance twice
    assert trial.log_odds == pytest.approx(-2.0 * np.log(CONFIG.significance))
    trial.update(-90.0, 106.0, CONFIG)  # half a window of new returns, 9 looks a witness
    assert trial.log_odds == pytest.approx(13.8 - 5.0, abs=0.02)
    trial.update(-180.0, 109.0, CONFIG)
    assert trial.is_lost and trial.is_open(117.0, CONFIG) and not trial.is_open(119.0, CONFIG)


def room(x: float, deep: float, alcove: float) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Walls of a room of its own shape."""
    corners = [(0.0, 0.0), (7.0, 0.0), (7.0, alcove), (8.2, alcove), (8.2, deep), (0.0, deep), (0.0, 0.0)]
    return [((a[0] + x, a[1]), (b[0] + x, b[1])) for a, b in pairwise(corners)]


def seen_again(there: float, shift: tuple[float, float, float]) -> float | None:
    """Evidence of the map for 5 m in a room, and later 5 m in that room or another one at x = `there`, tied to it."""
    walls = np.array(room(0.0, 4.0, 1.5) + room(30.0, 6.0, 3.4))
    first = [np.array((1.0 + 0.5 * k, 1.3, 0.3)) for k in range(11)]
    later, frames = [np.array((there + 1.0 + 0.5 * k, 2.4, 0.1)) for k in range(11)], []
    for pose in [*first, *later]:
        ranges = cast(walls, np.zeros((len(walls), 256)), pose, ANGLES)
        ends = ranges[:, None] * np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=1)
        frames.append(Keyframe(len(frames), [], returns=np.hstack((np.zeros_like(ends), ends))))
    back = [pose - (there, 0.0, 0.0) + shift for pose in later]
    backend = graph_of([*first, *back])
    lengths = np.append(0.5 * np.arange(11.0), 30.0 + 0.5 * np.arange(11.0))
    path = DrivenPath(np.arange(22), backend.poses([pose_symbol(k) for k in range(22)]), lengths)
    return evidence_of_map(Surroundings(path, frames, LandmarkMap(), backend, CONFIG, 2))


def test_what_is_seen_speaks_for_a_true_loop_and_against_a_false_one():
    right, other_room, turned = seen_again(0.0, (0, 0, 0)), seen_again(30.0, (0, 0, 0)), seen_again(0.0, (0, 0, 1.6))
    assert right is not None and right > 100.0
    assert other_room is not None and other_room < 0.5 * right  # three of its walls stand alike
    assert turned is not None and turned < 0.0
