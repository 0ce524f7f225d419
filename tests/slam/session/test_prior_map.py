"""A finished map as the prior of another mission: honest about where the robot is, extended by what is new."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import gtsam
import numpy as np
import pytest
from shapely import box

from factors import map_prior, plane_landmark
from factors.association.observations import PlaneObservation
from slam import PlaneSlam
from slam.errors import LogError
from slam.frontend.keyframes import Keyframe
from slam.geometry.frames import inverse, planar_transform
from slam.io.planes_json import write_planes
from slam.map.map_planes import MapPlane
from slam.planeslam import pose_symbol
from slam.registration.initial_pose import find_start
from slam.session.prior_map import PriorMap, floor_start, map_covariance, read_prior
from slam.session.store import SessionError
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.factors.factor_scenes import assert_jacobian
from tests.slam.commands import refused, run, values_of
from tests.slam.scenes import SIGMAS, Drive, drive, measured, planar_nees, room_planes, run_of
from tests.spplanes.fitting.fit_scenes import error_of
from tests.statistics import assert_mean_in_band, central_differences

#: Floor and three walls are mapped first; ceiling and the fourth wall are new to the second mission.
KNOWN = (0, 2, 4, 5)
START_M, START_RAD = 0.1, 0.05


@cache
def mapped(seed: int) -> PlaneSlam:
    """A mission that sees four of the room's six planes."""
    return run_of(replace(one, observations=[one.observations[i] for i in KNOWN]) for one in drive(seed).keyframes)


def prior_of(slam: PlaneSlam, start: np.ndarray) -> PriorMap:
    covariance = map_covariance(slam.planes, slam.landmarks, slam.backend)
    return PriorMap(slam.planes, covariance, start, floor_start(START_M, START_RAD))


def rough_start(scene: Drive, rng: np.random.Generator) -> np.ndarray:
    x, y = START_M * rng.standard_normal(2)
    return scene.world_T_body[0] @ planar_transform(x, y, START_RAD * rng.standard_normal())


def test_localising_in_a_prior_map_is_honest_and_extends_it():
    """Pose NEES (3 dof in the floor plane) at the start and at the end, and of every plane, known or new.

    16 runs: twice a covariance is off its band in 84 of 100 for each of the four, half of it in 71.
    """
    first, last, known, new = [], [], [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        earlier, scene = mapped(seed), drive(1000 + seed)
        slam = run_of(scene.keyframes, PlaneSlam(prior=prior_of(earlier, rough_start(scene, rng))))
        assert [plane.id for plane in slam.planes] == [0, 1, 2, 3, 4, 5]
        assert [round(plane.observations, -1) for plane in slam.planes[:4]] == [30] * 4
        for index, found in ((0, first), (14, last)):
            covariance, estimate = slam.marginal_covariance(pose_symbol(index)), slam.trajectory.poses[index]
            found.append(planar_nees(covariance, scene.world_T_body[index], estimate))
        nees = [one.plane.mahalanobis(truth_of(one)) for one in slam.planes]
        known.append(np.mean(nees[:4]))
        new.append(np.mean(nees[4:]))
    for found in (first, last, known, new):
        assert_mean_in_band(np.array(found), 3)


def truth_of(one: MapPlane) -> Plane:
    return max(room_planes(), key=lambda plane: plane.normal @ one.plane.normal)


def test_planes_of_a_map_that_were_taken_for_one_part_again():
    """Their variables never left the graph: what they share is one factor of all of them."""
    earlier, scene = mapped(3), drive(1003)
    slam = run_of(scene.keyframes, PlaneSlam(prior=prior_of(earlier, rough_start(scene, np.random.default_rng(3)))))
    before = [(one.id, one.observations) for one in slam.planes]
    merge = slam.merges.merge(2, 3, "same plane")
    assert [one.id for one in slam.planes] == [0, 1, 2, 4, 5]
    slam.merges.undo(merge)
    assert [(one.id, one.observations) for one in slam.planes] == before


def test_what_planes_of_a_map_share_is_what_the_graph_says_they_do():
    """By differences, from the marginals of the graph solved as one; each one's own part is its covariance."""
    slam = mapped(0)
    values, owners = slam.backend.values, [slam.landmarks[one.id] for one in slam.planes]
    keys = sorted({key for one in owners for key in (one.anchor_key, one.key)})

    def moved(key: int, step: np.ndarray) -> np.ndarray:
        steps = gtsam.VectorValues()
        steps.insert(key, step)
        now, found = values.retract(steps), []
        for one, known in zip(owners, slam.planes, strict=True):
            world = now.atOrientedPlane3(one.key).transform(now.atPose3(one.anchor_key).inverse()).planeCoefficients()
            found.append(error_of(known.plane.frame, Plane.from_hesse(world[:3], -world[3], np.zeros((3, 3))).frame))
        return np.concatenate(found)

    sizes = [6 if chr(key >> 56) == "x" else 3 for key in keys]
    columns = [central_differences(partial(moved, key), np.zeros(size)) for key, size in zip(keys, sizes, strict=True)]
    whole = gtsam.Marginals(slam.backend.graph, values).jointMarginalCovariance(keys).fullMatrix()
    expected = np.hstack(columns) @ whole @ np.hstack(columns).T
    sigmas = np.sqrt(np.diag(expected))
    found = map_covariance(slam.planes, slam.landmarks, slam.backend)
    for row, one in enumerate(slam.planes):
        block = found[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]
        np.testing.assert_allclose(block, one.plane.covariance, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=0.02)
    assert np.abs(np.triu(expected / np.outer(sigmas, sigmas), 3)).max() > 0.1


@pytest.mark.parametrize("shared", [0.0, 0.05])
def test_an_error_that_all_planes_share_is_not_averaged_away(shared: float):
    """A map shifted as a whole by 5 cm along x: no number of planes seen makes the robot's x surer than that."""
    planes = room_planes()
    own = np.diag(np.tile(np.square([0.004, 0.003, 0.003]), len(planes)))
    along_x = np.zeros(3 * len(planes))
    along_x[::3] = [plane.normal[0] for plane in planes]
    covariance = own + shared**2 * np.outer(along_x, along_x)
    entries = [MapPlane(i, replace(p, n_points=9), p.outline, 5, ("plane",)) for i, p in enumerate(planes)]  # type: ignore[arg-type]
    scene = drive(3)
    prior = PriorMap(entries, covariance, scene.world_T_body[0], floor_start(0.5, START_RAD))
    slam = run_of(scene.keyframes, PlaneSlam(prior=prior))
    last = scene.world_T_body[-1]
    spread = last[:3, :3] @ slam.marginal_covariance(pose_symbol(14))[3:, 3:] @ last[:3, :3].T
    sigma_x = float(np.sqrt(spread[0, 0]))
    assert shared / np.hypot(1.0, shared / 0.5) <= sigma_x < shared + 0.006  # the start is known to 0.5 m beside it
    assert np.sqrt(spread[1, 1]) < 0.006


def test_the_prior_of_a_map_is_the_gaussian_it_says():
    """The factor's error at planes moved by p is half p^T C^-1 p, its jacobian the derivative by the tangent."""
    rng = np.random.default_rng(0)
    planes = room_planes()[:3]
    root = rng.standard_normal((9, 9)) * 0.003
    covariance = root @ root.T + 1e-6 * np.eye(9)
    keys = [gtsam.symbol("p", i) for i in range(3)]
    factor = map_prior(planes, keys, covariance)
    values, moved = gtsam.Values(), 1e-4 * rng.standard_normal(9)
    for i, (key, plane) in enumerate(zip(keys, planes, strict=True)):
        z, theta, psi = moved[3 * i : 3 * i + 3]
        normal = plane.normal + theta * plane.frame[:3, 0] - psi * plane.frame[:3, 1]
        normal /= np.linalg.norm(normal)
        d = normal @ plane.centre + z
        values.insert(key, plane_landmark(Plane.from_hesse(normal, d, np.zeros((3, 3)))))
    assert factor.error(values) == pytest.approx(0.5 * moved @ np.linalg.solve(covariance, moved), rel=1e-3)
    assert_jacobian(factor, values)


PLANE = room_planes()[0]
#: A covariance that is below zero by rounding.
BELOW = np.diag([1.0, 1.0, -1e-14])
ENTRY, KEY = MapPlane(0, PLANE, PLANE.outline, 3, ("plane",)), gtsam.symbol("p", 0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: map_prior([PLANE], [KEY], np.zeros((3, 3))), "expected a positive definite covariance"),
        (lambda: map_prior([PLANE], [], np.eye(3)), "planes: expected as many as plane_keys"),
        (lambda: map_prior([PLANE], [KEY], np.eye(6)), r"covariance: expected shape \(3, 3\)"),
        (lambda: PriorMap([], np.empty((0, 0)), np.eye(4), np.eye(6)), "planes: expected at least one plane, got none"),
        (lambda: PriorMap([ENTRY], np.eye(3), np.eye(4), np.zeros((6, 6))), "start_covariance: expected a positive"),
        (lambda: PriorMap([ENTRY], BELOW, np.eye(4), np.eye(6)), "covariance: expected standard deviations of planes"),
    ],
)
def test_bad_priors_are_refused(make: Callable[[], object], sentence: str):
    with pytest.raises(ValueError, match=sentence):
        make()


def corner_map() -> list[MapPlane]:
    """The room with half of one wall a metre further out: no turn of it is the same."""
    planes = room_planes()
    halves = [
        replace(planes[5], frame=planes[5].frame @ shifted, outline=box(-2.0, -1.5, 2.0, 1.5))
        for shifted in (transform_from_rpy((-2.0, 0, 0, 0, 0, 0)), transform_from_rpy((2.0, 0, -1.0, 0, 0, 0)))
    ]
    return [as_entry(number, plane) for number, plane in enumerate([*planes[:5], *halves])]


def as_entry(number: int, plane: Plane) -> MapPlane:
    known = replace(plane, covariance=1e-5 * np.eye(3), n_points=500)
    return MapPlane(number, known, known.outline, 5, ("plane",))  # type: ignore[arg-type]


def seen_at(known: list[MapPlane], world_T_body: np.ndarray, seed: int) -> Keyframe:
    rng = np.random.default_rng(seed)
    planes = [measured(one.plane.transform(inverse(world_T_body)), rng) for one in known]
    return Keyframe(0, [PlaneObservation(replace(plane, covariance=np.diag(SIGMAS**2))) for plane in planes])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tipped", [0.0, 0.44], ids=["on the floor", "off the floor"])
def test_the_start_is_found_where_there_is_one(seed: int, tipped: float):
    """In the plane, or of a scanner at another height, tipped by up to 25 deg: all six directions, to centimetres."""
    known, rng = corner_map(), np.random.default_rng(seed)
    height, turns = (rng.uniform(0.5, 2.0) if tipped else 0.0), rng.uniform(-tipped, tipped, 2)
    truth = transform_from_rpy((*rng.uniform((-3.0, -2.0), (3.0, 2.0)), height, rng.uniform(-np.pi, np.pi), *turns))
    error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ find_start(known, seen_at(known, truth, seed))))
    assert np.linalg.norm(error[3:]) < 0.05 and np.linalg.norm(error[:3]) < 0.01


def test_a_start_as_words(tmp_path: Path):
    """Three numbers are on the floor; six, and what is found off it, are as wide in all directions."""
    path, known = tmp_path / "planes.json", corner_map()
    write_planes(path, known)
    floor = read_prior(path, "1,2,90", "0.1,2", lambda: Keyframe(0, []))
    np.testing.assert_allclose(floor.world_T_start, planar_transform(1.0, 2.0, np.pi / 2.0), atol=1e-12)
    np.testing.assert_array_equal(floor.start_covariance, floor_start(0.1, np.deg2rad(2.0)))
    where = (1.0, 2.0, 0.5, *np.deg2rad((90.0, 10.0, -5.0)).tolist())
    space = read_prior(path, "1,2,0.5,90,10,-5", "0.1,2", lambda: Keyframe(0, []))
    np.testing.assert_allclose(space.world_T_start, transform_from_rpy(where), atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(space.start_covariance)), [0.1] * 3 + [np.deg2rad(2.0)] * 3)
    found = read_prior(path, "find", "0.1,2", lambda: seen_at(known, transform_from_rpy(where), 0))
    np.testing.assert_array_equal(found.start_covariance, space.start_covariance)
    np.testing.assert_allclose(found.world_T_start, transform_from_rpy(where), atol=0.03)


def tilted(turn: float) -> Plane:
    """A sloping roof, as no room here has."""
    return room_planes()[1].transform(transform_from_rpy((0.0, 0.0, 1.0, 8.0 * turn, 0.4 + turn, 0.3)))


def test_a_start_that_cannot_be_told_is_refused():
    truth, room = planar_transform(1.0, 0.5, 0.3), [as_entry(*pair) for pair in enumerate(room_planes())]
    with pytest.raises(ValueError, match=r"found (1\.0,0\.5,17|-1\.0,-0\.5,-163) and (?!\1)-?1\.0,"):
        find_start(room, seen_at(room, truth, 0))
    with pytest.raises(ValueError, match="expected two walls of the map in the first keyframe, found none"):
        find_start(room, seen_at(room[:3], truth, 0))
    far = room[2].plane.frame @ transform_from_rpy((0.0, 0.0, -40.0, 0.0, 0.0, 0.0))
    stretched = [*room[3:], as_entry(2, replace(room[2].plane, frame=far))]
    with pytest.raises(ValueError, match=r"that explains 60 % of the walls .*, found \d+ %"):
        find_start(room[:3] + room[4:5], seen_at(stretched, truth, 0))
    off_the_floor = transform_from_rpy((1.0, 0.5, 1.2, 0.3, 0.3, -0.1))  # half a turn is the same room
    with pytest.raises(ValueError, match=r"expected one place .*, found -?1\.0,-?0\.5,1\.2,.* and -?\d"):
        find_start(room, seen_at(room, off_the_floor, 0))
    tilted_planes = [as_entry(k, tilted(0.2 * k)) for k in range(5)]
    with pytest.raises(ValueError, match=r"explains 60 % of the planes in the first keyframe, found \d+ %"):
        find_start(corner_map(), seen_at(tilted_planes, off_the_floor, 0))


def test_a_session_without_a_map_is_no_prior(tmp_path: Path):
    with PlaneSlam.open(tmp_path / "session.db") as slam:
        slam.add_keyframe(Keyframe(0, []))
    with pytest.raises(SessionError, match="expected a finished run, got one that has no map yet"):
        PriorMap.load(tmp_path / "session.db")
    with pytest.raises(LogError, match="cannot be read"):
        PriorMap.load(tmp_path / "planes.json")


def test_a_second_mission_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for seed in (1, 2):
        assert run(capsys, "simulate", "room", "--out", tmp_path / f"m{seed}", "--scans", 40, "--seed", seed)[0] == 0
    assert run(capsys, "slam", tmp_path / "m1", "--out", tmp_path / "first")[0] == 0
    again = ["slam", tmp_path / "m2", "--prior"]
    code, _, err = run(capsys, *again, tmp_path / "first", "--out", tmp_path / "second", "--start-sigma", "0.05,1")
    assert code == 0, err
    first, second = (PriorMap.load(tmp_path / name) for name in ("first", "second"))
    metrics = tmp_path / "second" / "metrics.json"
    grown = {one.id: one.observations for one in second.planes}
    assert all(grown[one.id] > one.observations for one in first.planes[:4])
    told = values_of(json.loads(metrics.read_text())["metrics"])
    assert told["planes of the prior map"] == len(first.planes)
    assert told["of them seen again"] == sum(grown[one.id] > one.observations for one in first.planes)
    assert [one.id for one in second.planes[: len(first.planes)]] == [one.id for one in first.planes]
    alone = PriorMap.load(tmp_path / "first" / "planes.json")
    shown = [one.plane for one in first.planes if one.plane.outline is not None]
    assert [one.plane.to_dict() for one in alone.planes] == [plane.to_dict() | {"chi2": 0.0} for plane in shown]
    assert alone.warnings and not first.warnings and "independent" not in err
    code, _, err = run(capsys, *again, tmp_path / "first" / "planes.json", "--out", tmp_path / "alone")
    assert code == 0 and f"warning: the {len(alone.planes)} planes of the prior map are taken as independent" in err
    assert alone.warnings[0] in json.loads((tmp_path / "alone" / "metrics.json").read_text())["warnings"]
    code, _, err = run(capsys, *again, tmp_path / "first", "--out", tmp_path / "no", "--start", "find")
    assert (code == 0) != (code == 2 and "--start: expected" in err and not (tmp_path / "no").exists())
    shutil.rmtree(tmp_path / "no", ignore_errors=True)
    for words, sentence in (
        (["--start", "1,2"], "--start: expected 3 or 6 numbers with commas between them, got '1,2'"),
        (["--start-sigma", "0,1"], "--start-sigma: expected two positive numbers"),
    ):
        assert sentence in refused(capsys, *again, tmp_path / "first", "--out", tmp_path / "no", *words)
        assert not (tmp_path / "no").exists()
