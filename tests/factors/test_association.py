"""Association for a graph of one's own: calibrated, independent of orders, joint, the same from every source."""

import re
import textwrap
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import binom
from shapely import box
from shapely.affinity import translate

import factors
from factors import AssociationGates, LandmarkExtents, LineObservation, PlaneObservation, Prediction, associate
from factors.association.landmark_extents import place_all
from spplanes import Plane, fit_plane
from tests.factors.association_scenes import (
    MAPPED,
    X,
    asked,
    drawn,
    frame_of,
    key,
    plane_of,
    scene,
    scene_off_ahead,
    tangent_covariance,
)
from tests.factors.factor_scenes import graph_of, random_line, values_of

#: A level robot whose position is known to 20 cm and whose heading to half a degree; rotation first.
LOOSE = np.diag([1e-3, 1e-3, 9e-3, 0.2, 0.2, 1e-3]) ** 2
#: One whose walls cannot be taken for one another, and no pose moves by more than 3 cm.
FIRM = np.diag([1e-3, 1e-3, 3e-3, 0.01, 0.01, 1e-3]) ** 2
#: All surfaces of the room.
WHOLE = tuple(range(7))
SECOND = gtsam.symbol("x", 1)


def looks(runs: int, seed: int, covariance: np.ndarray, mapped: tuple[int, ...] = WHOLE, **how: float):
    """Truth (a key, or None), identity, of every observation of many poses that see five surfaces each."""
    rng = np.random.default_rng(seed)
    for _ in range(runs):
        place = scene(covariance, rng, mapped)
        numbers = rng.permutation(len(WHOLE))[:5].tolist()
        seen = [place.line(n, rng) if n != 4 and rng.uniform() < 0.4 else place.seen(n, rng) for n in numbers]
        for number, identity in zip(numbers, asked(place, seen, **how).identities, strict=True):
            yield key(number) if number in mapped else None, identity


@pytest.mark.parametrize("mapped", [WHOLE, (0, 1, 2, 4, 6)], ids=["all known", "two of seven unknown"])
def test_probabilities_hold(mapped: tuple[int, ...]):
    told = list(looks(60, 1, LOOSE, mapped))
    claims = [(one.plane_key == truth) for truth, one in told if one.verdict == "match" and one.probability >= 0.99]
    assert len(claims) > 100
    assert len(claims) - sum(claims) <= binom.ppf(0.999, len(claims), 0.01)
    all_claims = [(p, landmark == truth) for truth, one in told for landmark, p in one.probabilities.items()]
    p, right = np.array(all_claims, dtype=float).T
    for low, high in ((0.0, 0.05), (0.05, 0.2)):  # what is claimed to be improbable is
        among = (p >= low) & (p < high)
        assert right[among].sum() <= binom.ppf(0.999, int(among.sum()), p[among].mean())
    wrong = sum(one.verdict == "match" and one.plane_key != truth for truth, one in told)
    assert wrong <= 0.05 * len(told)
    assert all(sum(one.probabilities.values()) == pytest.approx(1.0) for _, one in told)


@pytest.mark.parametrize("significance", [0.2, 0.05])
def test_true_matches_are_refused_as_often_as_the_gate_says(significance: float):
    told = list(looks(80, 2, FIRM, significance=significance, new_significance=1e-9))
    refused = sum(one.verdict != "match" for _, one in told)
    low, high = binom.ppf((0.0005, 0.9995), len(told), significance)
    assert low <= refused <= high
    assert not any(one.verdict == "match" and one.plane_key != truth for truth, one in told)


def test_the_order_of_observations_and_landmarks_changes_nothing():
    rng = np.random.default_rng(4)
    place = scene(LOOSE, rng, (0, 1, 2, 4, 6))
    alike = [replace(place.seen(number, rng), n_points=300) for number in WHOLE]
    first = asked(place, alike)
    order = [3, 6, 0, 5, 2, 4, 1]
    landmarks = LandmarkExtents()
    for landmark in reversed(list(place.landmarks)):
        landmarks._landmarks[landmark.key] = landmark
    again = asked(replace(place, landmarks=landmarks), [alike[number] for number in order])
    for index, number in enumerate(order):
        one, other = first.identities[number], again.identities[index]
        assert (one.verdict, one.plane_key, one.probabilities) == (other.verdict, other.plane_key, other.probabilities)
    assert {tuple(order[member] for member in group) for group in again.new_planes} == set(first.new_planes)


def test_two_walls_nearer_than_the_pose_is_known_are_told_apart_by_all_that_is_seen():
    """A cabinet 0.6 m before a wall, and a pose 0.4 m too far back: by itself the wall is rather the cabinet."""
    rng = np.random.default_rng(5)
    place = scene_off_ahead(-0.4, rng, (0, 1, 5))
    wall = replace(place.seen(0, rng), outline=box(-2.0, -1.2, -1.0, 0.0))  # behind where the cabinet is
    [alone] = asked(place, [wall]).identities
    likeliest = max(alone.probabilities, key=lambda landmark: alone.probabilities[landmark])
    assert likeliest == key(5) and alone.candidates[0].landmark == key(5)
    assert alone.probability < 0.9
    together = asked(place, [wall, replace(place.seen(1, rng), n_points=10)]).identities
    assert [one.plane_key for one in together] == [key(0), key(1)]
    assert min(one.probability for one in together) > 0.95


@pytest.mark.parametrize(
    ("sigma_m", "on_m", "verdict"), [(0.02, 1.0, "match"), (0.25, 1.0, "unsure"), (0.25, 0.0, "match")]
)
def test_what_lies_beside_a_landmark_is_another_plane_where_the_pose_is_poorly_known(
    sigma_m: float, on_m: float, verdict: str
):
    """2.6 standard deviations off, and a metre on from where the wall was seen: 0.65 m beside it others lie too.

    By chi2 it is the wall in each case. Where that was seen it is taken for it.
    """
    place = scene_off_ahead(2.6 * sigma_m, np.random.default_rng(6), (0,), sigma_m)
    seen = place.seen(0, np.random.default_rng(7))
    seen = replace(seen, outline=translate(seen.outline, (5.6 + on_m) * (on_m > 0.0)))
    [one] = associate([seen], place.prediction, place.landmarks).identities
    assert 5.0 < one.candidates[0].chi2 < 8.0
    assert one.verdict == verdict and (on_m == 0.0 or (one.probabilities[key(0)] > 0.5) == (verdict == "match"))


def test_of_two_faces_that_may_be_one_wall_it_is_the_one_seen_where_that_is_known():
    """A cabinet that no map has, 0.6 m before a wall and 0.3 m beside it; the pose leads between both."""
    rng = np.random.default_rng(8)
    place = scene_off_ahead(0.32, rng, (0, 2, 4))
    cabinet = replace(place.seen(5, rng), outline=box(-2.0, -0.6, -1.6, 0.6), n_points=1000)
    wall = replace(place.seen(0, rng), n_points=10)
    alone = associate([cabinet], place.prediction, place.landmarks).identities
    both = associate([cabinet, wall], place.prediction, place.landmarks).identities
    assert [one.plane_key for one in alone] == [key(0)] and [one.plane_key for one in both] == [None, key(0)]
    assert both[1].probability > 0.5


def test_a_wall_that_goes_on_is_as_probable_however_far_on_it_is_seen():
    found = []
    for on_m in (0.1, 1.4):
        rng = np.random.default_rng(1)
        place = scene(FIRM, rng, (0, 1, 2, 3, 4))
        piece = replace(place.seen(0, rng), outline=box(2.8 + on_m, -1.0, 3.8 + on_m, 1.0))
        [alone] = associate([piece], place.prediction, place.landmarks).identities
        assert alone.plane_key == key(0)
        found.append(alone.probability)
    assert found[0] == pytest.approx(found[1], rel=1e-3) and found[0] > 0.9


def test_of_two_faces_that_fit_it_is_the_one_that_was_seen_there():
    """Two doors of one front, 4 mm out of line and 3 m apart: only their extents tell which is seen."""
    values, landmarks, frame = values_of(x0=gtsam.Pose3()), LandmarkExtents(), plane_of(0).frame
    doors = []
    for number, (shift, low) in enumerate(((0.0, -2.0), (0.004, 1.0))):
        moved = frame.copy()
        moved[0, 3] += shift
        doors.append(Plane(moved, MAPPED, 500, box(low, -1.0, low + 1.0, 1.0)))
        values.insert(key(number), landmarks.start(key(number), doors[-1], X, values))
        landmarks[key(number)].pose_keys.add(-1)
    covariance = block_diag(np.diag([1e-3, 1e-3, 1e-3, 0.02, 0.02, 1e-3]) ** 2, np.zeros((6, 6)))
    prediction = Prediction.of_matrix(covariance, [X, key(0), key(1)], values, X)
    for number, door in enumerate(doors):
        [alone] = associate([drawn(door, MAPPED, np.random.default_rng(number))], prediction, landmarks).identities
        assert alone.plane_key == key(number)
        assert alone.probability > 0.9


def solved() -> tuple[gtsam.ISAM2, gtsam.NonlinearFactorGraph, LandmarkExtents, list[Plane | LineObservation]]:
    """Two poses by a relative prior; the first has mapped the room in its own frame, the second is about to look."""
    rng = np.random.default_rng(6)
    moved = gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([0.4, 0.1, 0.0]))
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3, 1e-3, 0.01, 0.1, 0.1, 1e-3]))
    step = gtsam.BetweenFactorPose3(X, SECOND, moved, noise)
    graph = graph_of(factors.pose_prior(X, gtsam.Pose3(), np.diag([1e-3] * 6) ** 2), step)
    isam = gtsam.ISAM2(factors.isam2_parameters())
    isam.update(graph, values_of(x0=gtsam.Pose3(), x1=moved))
    prediction, landmarks = Prediction.of_isam(isam, X), LandmarkExtents()
    new_graph, new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number in WHOLE:
        plane = drawn(plane_of(number), MAPPED, rng)
        initial = landmarks.start(key(number), plane, X, prediction.values, anchor_key=X)
        new_values.insert(key(number), initial)
        start = gtsam.Values(prediction.values)
        start.insert(key(number), initial)
        factor = factors.observation_factor(plane, X, landmarks[key(number)], replace(prediction, values=start))
        new_graph.push_back(factor)
    graph.push_back(new_graph)
    isam.update(new_graph, new_values)
    factors.settle(isam)
    there = gtsam.Pose3(gtsam.Rot3.Yaw(0.21), np.array([0.5, 0.0, 0.0]))
    seen = [drawn(plane_of(number).transform(there.inverse().matrix()), MAPPED, rng) for number in WHOLE]
    return isam, graph, landmarks, seen


def drifted(sigma_m: float, there: gtsam.Pose3, landmarks: LandmarkExtents) -> Prediction:
    """A pose that is known to 1 cm from the anchor of the cabinet's front, both to `sigma_m` in the world."""
    anchor, world_T_anchor = gtsam.symbol("a", 0), gtsam.Pose3(gtsam.Rot3.Yaw(0.8), np.array([1.0, -2.0, 0.3]))
    values, front = values_of(a0=world_T_anchor, x0=there), plane_of(5).transform(world_T_anchor.inverse().matrix())
    values.insert(key(5), landmarks.start(key(5), front, anchor, values, anchor_key=anchor))
    landmarks[key(5)].pose_keys.add(-1)
    together = np.vstack([pose.inverse().AdjointMap() for pose in (world_T_anchor, there)])
    shared = together @ np.diag([1e-3, 1e-3, 1e-2, sigma_m, sigma_m, sigma_m]) ** 2 @ together.T
    covariance = block_diag(shared + block_diag(np.zeros((6, 6)), FIRM), MAPPED)
    return Prediction.of_matrix(covariance, [anchor, X, key(5)], values, X)


@pytest.mark.parametrize("drift_m", [0.01, 2.0])
def test_a_wall_goes_on_as_far_as_is_known_of_the_pose_from_it_not_of_both_in_the_world(drift_m: float):
    there = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([0.2, -0.4, 0.0]))
    verdicts = []
    for end_m in (0.0, -2.0):  # of the cabinet's front from 1 m to 2 m, what is seen ends so far along it
        prediction = drifted(drift_m, there, landmarks := LandmarkExtents())
        piece = replace(plane_of(5), frame=frame_of((-1.0, 0.0, 0.0), (3.4, end_m - 0.5, -0.6)))
        (one,) = associate([piece.transform(there.inverse().matrix())], prediction, landmarks).identities
        verdicts.append(one.verdict)
    assert verdicts[0] == "match"
    assert verdicts[1] == ("new" if drift_m < 0.1 else "unsure")


def test_isam_marginals_and_a_matrix_give_the_same_answer():
    isam, graph, landmarks, seen = solved()
    values = isam.calculateEstimate()
    marginals, keys = gtsam.Marginals(graph, values), [X, SECOND, *(landmark.key for landmark in landmarks)]
    sources = [
        Prediction.of_isam(isam, SECOND),
        Prediction.of_marginals(marginals, values, SECOND),
        Prediction.of_matrix(factors.joint_covariance(marginals, keys), keys, values, SECOND),
    ]
    first, *others = [associate(seen, source, landmarks) for source in sources]
    assert [one.plane_key for one in first.identities] == [key(number) for number in WHOLE]
    for other in others:
        for one, same in zip(first.identities, other.identities, strict=True):
            assert (one.verdict, one.plane_key) == (same.verdict, same.plane_key)
            assert one.probability == pytest.approx(same.probability, abs=1e-6)
            assert one.candidates[0].chi2 == pytest.approx(same.candidates[0].chi2, rel=1e-4, abs=1e-6)


def test_what_the_docs_show_runs():
    text = Path(__file__).parents[2].joinpath("docs", "factors.md").read_text(encoding="utf-8")
    [snippet] = re.findall(r"^    landmarks = LandmarkExtents\(\).*\n((?:    .*\n)+)", text, re.MULTILINE)
    isam, _, landmarks, seen = solved()
    names = {name: getattr(factors, name) for name in factors.__all__}
    names |= {"isam": isam, "landmarks": landmarks, "seen": seen, "graph": gtsam.NonlinearFactorGraph()}
    names |= {"values": gtsam.Values(), "plane_key": key(9), "i": 0, "pose_key": SECOND, "anchor_key": X}
    exec(textwrap.dedent(snippet), names)  # noqa: S102 - our own page
    assert names["graph"].size() == len(seen) + 1 and len(landmarks) == len(seen) + 1


def test_a_prediction_from_before_an_update_is_refused():
    """Its estimates stay as they were, and covariances are those of now: all that is seen would be new."""
    isam, _, landmarks, seen = solved()
    prediction, moved = Prediction.of_isam(isam, SECOND), gtsam.Pose3.Expmap([0, 0, 0, 0.1, 0, 0]).matrix()
    isam.update(graph_of(factors.pose_prior(SECOND, prediction.pose(SECOND) @ moved, FIRM)), gtsam.Values())
    with pytest.raises(ValueError, match="prediction: expected that of isam as it is, got one from before its last up"):
        associate(seen, prediction, landmarks)
    associate(seen, Prediction.of_isam(isam, SECOND), landmarks)


def test_a_prediction_keeps_the_values_that_it_was_given():
    place = scene(FIRM, np.random.default_rng(7), (0,))
    prediction, before = place.prediction, place.values.atPose3(X).matrix()
    place.values.update(X, gtsam.Pose3())
    np.testing.assert_array_equal(prediction.pose(X), before)


def fitted(middle: tuple[float, float], rng: np.random.Generator) -> Plane:
    """A piece of a wall, 4 m by 1 m, without an outline."""
    across, along = 0.01 * rng.standard_normal(400), np.array(middle) + rng.uniform((-2, -0.5), (2, 0.5), (400, 2))
    return fit_plane(np.column_stack((across + 4.0, along)), sigma=0.01, viewpoint=np.zeros(3))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.7, -0.4)])
def test_a_plane_without_an_outline_is_as_large_as_its_points_scatter(shift: tuple[float, float]):
    """Wherever on it its frame is: p at another origin is z - theta a + psi b, theta, psi."""
    plane, (a, b) = fitted((1.0, 0.0), np.random.default_rng(1)), shift
    frame, by_shift = plane.frame.copy(), np.array([[1.0, -a, b], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    frame[:3, 3] += frame[:3, :2] @ shift
    moved = Plane(frame, by_shift @ plane.covariance @ by_shift.T, plane.n_points)
    patch = PlaneObservation(moved).patch_in(frame_of((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)).T)
    assert patch.intersection(box(-1.0, -0.5, 3.0, 0.5)).area > 0.9 * max(4.0, patch.area)
    assert PlaneObservation(replace(moved, n_points=0)).patch_in(np.eye(4)).geom_type == "Point"


@pytest.mark.parametrize("on_m", [2.0, 3.0])
def test_a_wall_without_an_outline_goes_on(on_m: float):
    rng, values, landmarks = np.random.default_rng(2), values_of(x0=gtsam.Pose3()), LandmarkExtents()
    known = fitted((0.0, 0.0), rng)
    values.insert(key(0), landmarks.start(key(0), known, X, values))
    covariance = block_diag(FIRM, tangent_covariance(known))
    [one] = associate([fitted((on_m, 0.0), rng)], of_matrix(covariance, [X, key(0)], values, X), landmarks).identities
    assert one.verdict == "match"


def test_extents_grow_where_the_estimate_has_the_landmark():
    place = scene(FIRM, np.random.default_rng(7), (0,))
    values = gtsam.Values(place.values)
    values.update(X, gtsam.Pose3())
    half = Plane(plane_of(0).frame, MAPPED, 100, box(2.8, -1.2, 4.0, 1.2))
    before = place.landmarks[key(0)].outline.area
    place.landmarks.see(key(0), half, X, values)
    assert place.landmarks[key(0)].outline.area == pytest.approx(before + 1.2 * 2.4, rel=0.01)
    assert place.landmarks[key(0)].n_keyframes == 2
    assert place.landmarks.remove(key(0)).key == key(0)
    assert len(place.landmarks) == 0 and key(0) not in place.landmarks


@pytest.mark.parametrize("anchor", [gtsam.symbol("a", 0), None])
def test_a_landmark_that_moves_to_another_anchor_stays_where_it_was_seen(anchor: int | None):
    place, world_T_anchor = scene(FIRM, np.random.default_rng(7), (0,)), gtsam.Pose3(gtsam.Rot3.Yaw(1.2), [2.0, 1.0, 0])
    place.values.insert(gtsam.symbol("a", 0), world_T_anchor)
    before = place_all(list(place.landmarks), place.values)
    place.values.update(key(0), place.landmarks.change_anchor(key(0), anchor, place.values))
    assert place.landmarks[key(0)].anchor_key == anchor and place.landmarks[key(0)].n_keyframes == 2
    np.testing.assert_allclose(place_all(list(place.landmarks), place.values), before, atol=1e-12)
    with pytest.raises(FrozenInstanceError):
        place.landmarks[key(0)].anchor_key = X  # type: ignore[misc]


def test_pieces_of_a_wall_that_nobody_knew_are_one_new_plane():
    place = scene(FIRM, np.random.default_rng(8), (0, 1))
    rng = np.random.default_rng(9)
    wall = place.seen(3, rng)
    pieces = [replace(wall, outline=box(low, -1.0, low + 1.0, 1.0), n_points=n) for low, n in ((-3.0, 90), (-1.5, 80))]
    found = asked(place, [pieces[0], place.seen(0, rng), pieces[1], place.seen(4, rng)])
    assert [one.verdict for one in found.identities] == ["new", "match", "new", "new"]
    assert sorted(sorted(group) for group in found.new_planes) == [[0, 2], [3]]
    assert len(found.new) == 3 and len(found.matches) == 1 and not found.unsure


PLACE = scene(FIRM, np.random.default_rng(10), (0, 1))
VALUES, MATRIX, SEEN = PLACE.values, PLACE.covariance, PLACE.seen(0, np.random.default_rng(0))
of_matrix = Prediction.of_matrix
of_none = of_matrix(np.eye(6), [X], values_of(x0=gtsam.Pose3()), X)
of_one = of_matrix(MATRIX[:9, :9], PLACE.keys[:2], VALUES, X)
of_all, BOTH = PLACE.prediction, [SEEN, PLACE.seen(1, np.random.default_rng(0))]
POSITIVE, PROBABILITY = "expected a positive finite number, got", "expected a number from 0 to 1"


def associated(seen, prediction, **how):
    return associate(seen, prediction, PLACE.landmarks, **how)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: of_matrix(np.nan * MATRIX, PLACE.keys, VALUES, X), "covariance: expected finite numbers, got NaN"),
        (lambda: of_matrix(-MATRIX, PLACE.keys, VALUES, X), "covariance: expected a positive semidefinite covariance"),
        (lambda: of_matrix(np.eye(6), PLACE.keys, VALUES, X), r"covariance: expected shape \(12, 12\), got \(6, 6\)"),
        (lambda: of_matrix(MATRIX, [X, key(0), key(9)], VALUES, X), "keys: expected the key of a Pose3 or .* got l9"),
        (lambda: of_matrix(np.eye(3), [key(0)], VALUES, X), "keys: expected the pose x0 among them, got l0"),
        (lambda: of_matrix(MATRIX, PLACE.keys, VALUES, key(0)), "pose_key: expected the key of a Pose3 .* l0, a plane"),
        (lambda: Prediction.of_isam(gtsam.ISAM2(), gtsam.symbol("x", 7)), "pose_key: expected the key .* got x7"),
        (lambda: associated(BOTH, of_one), "keys: expected all landmarks and anchors compared, got none of l1"),
        (lambda: associated([SEEN], of_none), "landmarks: expected the key of an OrientedPlane3 in values, got l0"),
        (lambda: associated([SEEN, 1.0], of_all), r"observations\[1\]: .* got float"),
        (lambda: associated(SEEN, of_all), "observations: expected a sequence, got Plane"),
        (lambda: associated([SEEN], of_all, wall_tilt_sigma_rad=-1.0), f"wall_tilt_sigma_rad: {POSITIVE}"),
        (lambda: associated([SEEN], of_all, wall_tilt_sigma_rad=np.nan), f"wall_tilt_sigma_rad: {POSITIVE}"),
        (lambda: of_matrix(np.eye(6), X, VALUES, X), "keys: expected a sequence, got int"),
        (lambda: associate([SEEN], PLACE.prediction, {}), "landmarks: expected a LandmarkExtents, got dict"),  # type: ignore[arg-type]
        (lambda: associated([SEEN], MATRIX), "prediction: expected a Prediction, got ndarray"),
        (lambda: associated([SEEN], of_all, least_probability=2.0), f"least_probability: {PROBABILITY}, got 2.0"),
        (lambda: AssociationGates(significance=0.0), "significance: expected a probability between 0 and 1, got 0.0"),
        (lambda: AssociationGates(gap_m=-1.0), "gap_m: expected a number >= 0, got -1.0"),
        (lambda: LineObservation(random_line(np.random.default_rng(0)), np.eye(3)), "body_T_sensor: expected shape"),
        (lambda: PLACE.landmarks.start(key(0), SEEN, X, VALUES), "plane_key: expected a new landmark's, got l0"),
        (
            lambda: PLACE.landmarks.start(X, SEEN, X, VALUES),
            "plane_key: expected the key of an OrientedPlane3 .* got x0",
        ),
        (lambda: PLACE.landmarks[[1]], r"plane_key: expected a landmark that was started, got \[1\]"),  # type: ignore[index]
        (lambda: PLACE.landmarks.change_anchor(key(0), key(1), VALUES), "anchor_key: expected .* got l1"),
        (lambda: PLACE.landmarks.see(key(5), SEEN, X, VALUES), "plane_key: expected a landmark that was started"),
        (lambda: PLACE.landmarks.see(key(0), SEEN, gtsam.symbol("x", 4), VALUES), "pose_key: expected .* got x4"),
    ],
)
def test_one_sentence_that_names_the_argument(make, sentence: str):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        make()


def test_nothing_seen_and_nothing_known_are_answers():
    place = scene(FIRM, np.random.default_rng(12), ())
    assert asked(place, []).identities == ()
    [one] = asked(place, [place.seen(0, np.random.default_rng(0))]).identities
    assert one.verdict == "new" and one.probability == 1.0
