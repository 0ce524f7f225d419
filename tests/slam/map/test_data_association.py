"""The arithmetic by which observations are told apart, and landmarks near a place, against numpy and scipy."""

from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution
from shapely import box

from benchmarks.growth import mission
from factors.association.decisions import AssociationGates, Candidate, Decision, decide, is_open
from factors.association.estimate import KeyedCovariance
from factors.association.gating import Hypothesis, State, eliminated
from factors.association.joint_association import JointCompatibility
from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.frontend.odometry import Motion
from slam.geometry.frames import planar_transform
from slam.map.landmarks import LandmarkMap
from spplanes import Plane
from tests.factors.association_scenes import frame_of
from tests.slam.scenes import NOISE, PERIOD_NS


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_what_is_eliminated_in_scalars_is_what_numpy_solves(size: int):
    rng = np.random.default_rng(size)
    for scale in (1e-6, 1.0, 1e6):
        root = scale * rng.normal(size=(size, size))
        covariance, (residual, direction) = root @ root.T + np.eye(size), rng.normal(size=(2, size))
        found, inverse = (
            eliminated(covariance.tolist(), residual.tolist(), direction.tolist()),
            np.linalg.inv(covariance),
        )
        assert np.isclose(found.chi2, residual @ inverse @ residual, rtol=1e-6)
        assert np.isclose(found.log_det, np.linalg.slogdet(2.0 * np.pi * covariance)[1], rtol=1e-9)
        assert np.isclose(found.pull, direction @ inverse @ residual, rtol=1e-5)
        assert np.isclose(found.precision, direction @ inverse @ direction, rtol=1e-6)


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
@pytest.mark.parametrize("chi2", [0.0, 1e-12, 1.0, 30.0, 1e4, np.inf, -1e-15])
def test_p_value_is_that_of_the_chi2_distribution(dof: int, chi2: float):
    assert Candidate(0, chi2, dof, 0.0, True).p_value == chi2_distribution.sf(chi2, dof)


def seen(normal: tuple[float, float, float], d: float, n_points: int, half_m: float) -> PlaneObservation:
    """A wall at x = 0 of the body, measured to 1 mm and 2 mrad without error."""
    frame = frame_of(normal, tuple(d * np.array(normal)))
    return PlaneObservation(Plane(frame, np.diag([1e-3, 2e-3, 2e-3]) ** 2, n_points, box(-half_m, -1.0, half_m, 1.0)))


@pytest.mark.parametrize("looks", [1, 4])
def test_a_board_that_is_seen_best_does_not_take_its_wall_and_the_pose_with_it(looks: int):
    walls = [seen((0.0, -1.0, 0.0), -1.1, 400, 3.0), seen((0.0, 1.0, 0.0), -1.1, 300, 3.0)]
    walls += [seen((0.0, 0.0, 1.0), -0.4, 200, 3.0), seen((-1.0, 0.0, 0.0), -9.0, 100, 1.0)]
    slam = PlaneSlam()
    for index in range(looks):
        slam.add_keyframe(Keyframe(index * PERIOD_NS, walls, None if index == 0 else step(0.01)))
    board = seen((0.0, -1.0, 0.0), -1.08, 1000, 0.5)
    report = slam.add_keyframe(Keyframe(looks * PERIOD_NS, [board, *walls[:3]], step(0.5)))
    matches = [one.landmark for one in report.decisions]
    assert matches == [None, 0, 1, 2] and abs(report.world_T_body[1, 3]) < 1e-3
    [alone] = slam.add_keyframe(Keyframe((looks + 1) * PERIOD_NS, [board], step(0.5))).decisions
    assert alone.candidates[0].p_value > 1e-3  # by itself the board could be its wall


def step(way_m: float) -> Motion:
    delta = np.array([way_m, 0.0, 0.0])
    return Motion(planar_transform(*delta), NOISE.covariance(delta), (1e-3, 1e-3, 1e-3))


def anywhere(_: int) -> bool:
    """A landmark may be it wherever it was seen."""
    return True


def test_of_two_that_it_could_be_it_is_the_one_seen_there_and_it_waits_only_for_a_rival_that_is_near():
    board, wall, rules = Candidate(7, 0.5, 2, 8.4, True), Candidate(2, 7.8, 2, 5.2, True), AssociationGates()

    def decided(far_from_board: float) -> Decision:
        far = {7: far_from_board, 2: 0.0}
        decision = decide(0, [board, wall], 0.0, far.__getitem__, anywhere, rules)
        assert decision.candidates == (board, wall)
        return decision

    for far, landmark in ((0.0, 7), (3.0, 7), (3.5, 2)):
        assert decided(far).match.landmark == landmark
    assert is_open(decided(3.5), {7: 3.5, 2: 0.0}.__getitem__, rules)
    assert not is_open(decided(3.5), {7: 8.0, 2: 0.0}.__getitem__, rules)
    alone = decide(0, [board], 0.0, {7: 8.0}.__getitem__, anywhere, rules)
    assert alone.match is board  # a wall goes on where it was not seen yet
    too_far = decide(0, [board], 0.0, {7: 8.0}.__getitem__, lambda _: False, rules)
    assert too_far.verdict == "unsure"  # but not anywhere


@pytest.mark.parametrize(
    ("p", "log_likelihood", "verdict"),
    [(2e-3, 1.0, "match"), (2e-3, -1.0, "unsure"), (5e-4, 1.0, "unsure"), (2e-6, 1.0, "unsure"), (5e-7, 1.0, "new")],
)
@pytest.mark.parametrize("dof", [2, 3])
def test_between_the_gates_and_where_another_plane_is_as_likely_neither_is_said(p, log_likelihood, verdict, dof):
    """What is unsure is left out: as a match it would pull the pose, as a new plane be in the map twice."""
    candidate = Candidate(7, float(chi2_distribution.isf(p, dof)), dof, log_likelihood, True)
    decision = decide(0, [candidate], 0.0, lambda _: 0.0, anywhere, AssociationGates())
    assert decision.verdict == verdict and decision.match is (candidate if verdict == "match" else None)


@pytest.mark.parametrize(("target", "verdict"), [(3.0, "match"), (6.0, "unsure")])
def test_a_match_that_only_a_hint_makes_fit_is_not_used(target: float, verdict: str):
    """The hint says that the pose is where the landmark fits; without it the landmark is 2.1 or 4.2 sigma off."""

    def hypothesis(sigma: float) -> Hypothesis:
        candidate, column = Candidate(0, 0.0, 1, 0.0, True), np.zeros(1, dtype=int)
        return Hypothesis(candidate, column, np.eye(1) / sigma, np.array([target]) / sigma, np.zeros(1))

    joint = KeyedCovariance([0], np.eye(1), [1])

    hinted, without_hint = State(joint), State(joint)
    hinted.condition(hinted.innovation(hypothesis(1e-3)))
    sought, rules = [[hypothesis(1.0)]], AssociationGates()
    gaps = SimpleNamespace(away=lambda *_: 0.0, within=lambda *_, **__: True)
    problem = JointCompatibility(sought, [-9.0], [-9.0], gaps, [1], hinted, without_hint, rules)
    decision = problem.best().decisions[0]
    assert decision.verdict == verdict
    if decision.match is not None:
        assert decision.match.chi2 == pytest.approx(target**2 / 2.0)  # and told as it is without the hint


def test_an_office_is_mapped_by_the_same_decisions(monkeypatch: pytest.MonkeyPatch):
    frames = [frame for frame, _ in islice(mission(40, 3), 40)]

    def decided() -> list[list]:
        slam = PlaneSlam()
        return [slam.add_keyframe(frame).decisions for frame in frames]

    at_once = decided()
    monkeypatch.setattr(LandmarkMap, "near", one_by_one)
    assert at_once == decided() and sum(one.match is not None for decisions in at_once for one in decisions) > 300


def one_by_one(self, normal, middle, reach, max_angle):
    """`LandmarkMap.near` by looking at every landmark."""
    found = []
    for landmark in (one for one in self if one.id in self._rows):
        place, (centre, radius) = self.placed(landmark.id), self.sphere(landmark.id)
        if place.normal @ normal >= np.cos(max_angle) and np.linalg.norm(centre - middle) <= radius + reach:
            found.append((landmark, place))
    return found
