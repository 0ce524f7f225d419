"""The warp of a depth camera: found from planes where there is one, with its size; none where there is none."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from benchmarks.corpus.drives.sensing import camera_beams
from slam.errors import LogError
from slam.frontend.measurement import usable_points
from slam.frontend.range_noise import with_shown_errors
from slam.frontend.warp_calibration import _likeliest, _Prior, with_warp
from slam.io.default_rigs import depth_rig
from slam.sensors.log import CloudScan, Log, StoredCloud
from slam.sensors.rig import RangeWarp, Rig, Sensor
from spplanes._check import FloatArray
from tests.spplanes.scenes import to_walls

CAMERA = depth_rig().sensors["camera"]
RAYS = camera_beams(120, 160, 134.0).directions
#: Half the sides of the room the camera is in, m.
HALF = np.array([1.6, 1.3, 1.2])


def image(rng: np.random.Generator) -> FloatArray:
    """Points (120, 160, 3) without noise, in the camera's frame, of a box from within, looking anywhere."""
    turn, place = Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3)
    return to_walls(RAYS @ turn.T, -HALF - place, HALF - place)[..., None] * RAYS


def log_of(images: list[FloatArray]) -> Log:
    return Log([CloudScan(k, "camera", points) for k, points in enumerate(images)], Path("room"))


def noisy(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """With the noise that the camera states."""
    ranges = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * (1.0 + np.sqrt(CAMERA.range_variance_at(ranges)) / ranges * rng.standard_normal(ranges.shape))


def drawn(rng: np.random.Generator, octave: float, *, grows: bool) -> RangeWarp:
    """A warp as the prior has it, of waves that planes can tell."""
    prior = _Prior.of_waves()
    weights = np.where(prior.told, prior.deviations(np.full(2, octave)), 0.0) * rng.standard_normal(len(prior.told))
    shares, per_m = weights.reshape(2, 6, 8)
    (shares if grows else per_m)[:] = 0.0
    return RangeWarp(shares=shares.tolist(), shares_per_m=per_m.tolist())


def put_on(points: FloatArray, warp: RangeWarp) -> FloatArray:
    """Points as a camera of that warp reads them: the range r' with r' = r (1 + a + b r')."""
    share, per_m = warp.over(*points.shape[:2])
    return points * ((1.0 + share) / (1.0 - per_m * np.linalg.norm(points, axis=-1)))[..., None]


def rest_at(warp: RangeWarp, found: RangeWarp, range_m: float) -> tuple[float, float]:
    """Standard deviations over the image of a warp, and of what one that was found leaves of it; without a scale."""
    true, by = ((1.0, range_m) @ one.over(120, 160).reshape(2, -1) for one in (warp, found))
    return float(np.std(true)), float(np.std(true - by))


@pytest.mark.parametrize("grows", [False, True])
def test_a_warp_is_found_from_planes_seen_anyhow(grows: bool) -> None:
    """A fifth of it is left at most, at a range about which walls are, and three times so much of none."""
    rng = np.random.default_rng(5 + grows)
    warp = drawn(rng, 0.003, grows=grows)
    log = log_of([noisy(put_on(image(rng), warp), rng) for _ in range(24)])
    found = with_warp("camera", CAMERA, log)
    assert found.warp is not None
    true, rest = rest_at(warp, found.warp, 1.5)
    assert true > 0.004 and rest < 0.2 * true
    assert len(log.notes) == 1 and "bend planes" in log.notes[0]
    shares, per_m = (np.square(one).sum() for one in (found.warp.shares, found.warp.shares_per_m))
    assert (per_m > shares) == grows
    seen = image(rng)
    read = put_on(seen, warp)
    assert np.abs(usable_points(read, found) - seen).max() < 0.25 * np.abs(read - seen).max()


@pytest.mark.parametrize("seed", [20, 21])
def test_what_bends_walls_into_pieces_is_found_as_these_go_together(seed: int) -> None:
    """Two looks leave a fifth and more of a warp of 5 %."""
    rng = np.random.default_rng(seed)
    warp = drawn(rng, 0.03, grows=False)
    found = with_warp("camera", CAMERA, log_of([noisy(put_on(image(rng), warp), rng) for _ in range(8)]))
    assert found.warp is not None
    true, rest = rest_at(warp, found.warp, 1.5)
    assert true > 0.04 and rest < 0.12 * true


def test_a_camera_without_a_warp_is_left_as_it_is() -> None:
    rng = np.random.default_rng(7)
    log = log_of([noisy(image(rng), rng) for _ in range(24)])
    assert with_warp("camera", CAMERA, log) is CAMERA and not log.notes


def test_uneven_walls_are_no_warp() -> None:
    """Waves of 6 mm of the walls themselves, seen at any pixels."""
    rng, images = np.random.default_rng(8), []
    for _ in range(24):
        points = image(rng)
        a, b = rng.uniform(-3.0, 3.0, (2, 3))
        images.append(noisy(points * (1.0 + 0.006 * np.sin(points @ a + b[0]))[..., None], rng))
    found = with_warp("camera", CAMERA, log_of(images))
    assert found.warp is None or np.std(found.warp.over(120, 160)[0]) < 0.0015


def test_what_maps_planes_to_planes_is_left() -> None:
    """Inverse ranges along the optical axis that err by what is linear in the image: all planes stay planes."""
    rng, images = np.random.default_rng(9), []
    for _ in range(24):
        points = image(rng)
        x, y, z = np.moveaxis(points, -1, 0)
        images.append(noisy(points / (1.0 + z * (0.01 * x / z - 0.02 * y / z + 0.01))[..., None], rng))
    found = with_warp("camera", CAMERA, log_of(images))
    assert found.warp is None or np.std((1.0, 1.5) @ found.warp.over(120, 160).reshape(2, -1)) < 0.001


def test_few_cameras_without_a_warp_are_given_one() -> None:
    """What 100 of them would tell by noise alone: 1 in 1,000 is stated, and both variances have a bound at nought."""
    rng, prior = np.random.default_rng(10), _Prior.of_waves()
    count = len(prior.told)
    root = rng.standard_normal((count, count)) * 1e3
    information, gains = root @ root.T, []
    for _ in range(100):
        gains.append(_likeliest(information, root @ rng.standard_normal(count), prior).evidence)
    assert np.mean(2.0 * np.array(gains) > 13.8) <= 0.01 and np.mean(2.0 * np.array(gains) > 2.7) <= 0.15


def test_other_sensors_have_none() -> None:
    """A spinning scanner, whose rays are of all sides; one whose rays are others each time; clouds without order."""
    rng = np.random.default_rng(11)
    turned = [noisy(image(rng), rng) @ Rotation.random(rng=rng).as_matrix().T for _ in range(4)]
    azimuth = np.linspace(-np.pi, np.pi, 400, endpoint=False) + np.zeros((16, 1))
    around = np.stack((np.cos(azimuth), np.sin(azimuth), 0.1 * np.sin(7.0 * azimuth)), axis=-1) * 3.0
    for images in (turned, [around] * 4, [one.reshape(-1, 3) for one in turned], []):
        assert with_warp("camera", CAMERA, log_of(images)) is CAMERA
    line = Sensor(kind="line", range_sigma_m=0.01, range_max_m=30.0)
    assert with_warp("front", line, log_of([])) is line


def test_images_that_cannot_be_read_are_left_out() -> None:
    def broken(_: int) -> FloatArray:
        raise LogError(Path("x"), "damaged")

    rng = np.random.default_rng(12)
    warp = drawn(rng, 0.003, grows=False)
    scans = log_of([noisy(put_on(image(rng), warp), rng) for _ in range(22)]).events
    stored = StoredCloud({"stamp_ns": 22, "sensor": "camera"}, {"points": broken})
    log = Log([*scans, stored, CloudScan(23, "camera", np.full((120, 160, 3), np.nan))], Path("x"))
    assert with_warp("camera", CAMERA, log).warp is not None


def test_a_stated_warp_is_taken_and_kept_in_files(tmp_path: Path) -> None:
    warp = RangeWarp(shares=((0.0, 0.01), (0.0, 0.0)), shares_per_m=((0.0, 0.0), (0.002, 0.0)))
    rig = Rig(sensors={"camera": CAMERA.model_copy(update={"warp": warp})})
    rig.to_yaml(tmp_path / "rig.yaml")
    assert Rig.from_yaml(tmp_path / "rig.yaml").sensors["camera"].warp == warp
    log = log_of([image(np.random.default_rng(13)) for _ in range(3)])
    assert with_shown_errors(log, rig) is rig and not log.notes
    half, (share, per_m) = np.cos(np.pi / 4.0), warp.over(2, 2)
    assert np.allclose(share, 0.01 * np.array([[half, -half]] * 2))
    assert np.allclose(per_m, 0.002 * np.array([[half] * 2, [-half] * 2]))
    points = np.full((2, 2, 3), 1.0)
    taken = usable_points(points, rig.sensors["camera"])
    assert np.allclose(points / taken, (1.0 + share + per_m * 3.0**0.5)[..., None])
    zeros = ((0.0,),)
    for wrong, per_m in ((zeros, ()), (((0.0,), (0.0, 1.0)), zeros * 2), (((np.nan,),), zeros)):
        with pytest.raises(ValidationError):
            RangeWarp(shares=wrong, shares_per_m=per_m)
