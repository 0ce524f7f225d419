"""The noise that scans show: what is stated too small is raised to it, what is honest or more is left as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.errors import LogError
from slam.frontend.range_noise import noise_factor, with_shown_errors
from slam.sensors.log import CloudScan, Event, LaserScan, Log, StoredCloud
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray
from tests.slam.short_drives import mapped_beginning
from tests.spplanes.scenes import spun, to_walls


def room(rng: np.random.Generator, sigma: float, *, rows: int = 16, columns: int = 600) -> FloatArray:
    """Points (rows, columns, 3) of a scanner in a box of 8 x 6 x 3 m, each range with its noise."""
    rays = spun(np.linspace(-0.3, 0.3, rows), np.linspace(-np.pi, np.pi, columns, endpoint=False))
    ranges = to_walls(rays, [-3.0, -4.0, -1.2], [5.0, 2.0, 1.8])
    return rays * (ranges + sigma * rng.standard_normal(ranges.shape))[..., None]


def log_of(grids: list[FloatArray], stated_m: float) -> tuple[Log, Rig]:
    """A log of clouds, and a rig that states that noise."""
    sensor = Sensor(kind="cloud", range_max_m=30.0, range_sigma_m=stated_m)
    scans: list[Event] = [CloudScan(k, "lidar", grid) for k, grid in enumerate(grids)]
    return Log(scans, Path("room")), Rig(sensors={"lidar": sensor})


@pytest.mark.parametrize("times", [0.25, 1.0, 4.0])
def test_what_neighbours_miss_is_the_noise_of_the_beams(times: float) -> None:
    rng = np.random.default_rng(3)
    grids = [room(rng, times * 0.01) for _ in range(4)]
    factor = noise_factor(grids, Sensor(kind="cloud", range_sigma_m=0.01, range_max_m=30.0))
    assert factor == pytest.approx(times, rel=0.05)


def test_noise_that_grows_with_the_square_of_the_range_and_uneven_walls_are_no_less_than_stated() -> None:
    rng = np.random.default_rng(4)
    clean = room(rng, 0.0)
    ranges = np.linalg.norm(clean, axis=-1, keepdims=True)
    grown = clean * (1.0 + 0.002 * ranges * rng.standard_normal(ranges.shape))
    camera = Sensor(kind="cloud", range_sigma_m=1e-4, disparity_sigma_per_m=0.002, range_max_m=30.0)
    assert noise_factor([grown], camera) == pytest.approx(1.0, rel=0.08)
    noisy = room(rng, 0.01)
    uneven = Sensor(kind="cloud", range_sigma_m=0.005, surface_sigma_m=0.01, range_max_m=30.0)
    even = uneven.model_copy(update={"surface_sigma_m": 0.0})
    assert noise_factor([noisy], uneven) < 1.0 < noise_factor([noisy], even)


def test_less_than_is_shown_is_not_believed_once_and_for_all() -> None:
    rng = np.random.default_rng(5)
    log, rig = log_of([room(rng, 0.015) for _ in range(8)], 0.0045)
    raised = with_shown_errors(log, rig)
    assert raised.sensors["lidar"].range_sigma_m == pytest.approx(0.015, rel=0.06)
    assert len(log.notes) == 1 and "lidar: ranges scatter about surfaces by 1" in log.notes[0] and "4.5" in log.notes[0]
    assert with_shown_errors(log, raised) is raised and with_shown_errors(log, rig) is raised and len(log.notes) == 1
    assert with_shown_errors(replace(log, notes=[]), raised) is raised  # another look at the same scans


@pytest.mark.parametrize("stated", [0.0135, 0.015, 0.045])
def test_an_honest_rig_and_one_that_states_more_stay_as_they_are(stated: float) -> None:
    rng = np.random.default_rng(6)
    log, rig = log_of([room(rng, 0.015) for _ in range(4)], stated)
    assert with_shown_errors(log, rig) is rig and not log.notes


def test_scans_that_cannot_be_read_or_show_too_little_tell_nothing() -> None:
    def damaged(_: int) -> FloatArray:
        raise LogError(Path("cloud.pcd"), "expected a cloud, got nothing")

    log, rig = log_of([room(np.random.default_rng(7), 0.015)], 0.001)
    broken = replace(log, events=[StoredCloud({"stamp_ns": 0, "sensor": "lidar"}, {"points": damaged}), *log.events])
    assert with_shown_errors(broken, rig).sensors["lidar"].range_sigma_m == pytest.approx(0.015, rel=0.1)
    nothing = [CloudScan(0, "lidar", np.full((4, 9, 3), np.nan)), CloudScan(1, "lidar", np.ones((1, 3)))]
    for events in (nothing, []):
        assert with_shown_errors(replace(log, events=events), rig) is rig


@pytest.mark.parametrize(
    "name", ["cluttered/lidar32", "hall/lidar16", "irregular/depth", "people/level", "glass/pushbroom"]
)
def test_drives_whose_rigs_are_honest_keep_them(name: str) -> None:
    drive = make_drive(Recipe.parse(name), 91)
    assert with_shown_errors(drive.log, drive.rig) is drive.rig


def test_a_drive_whose_rig_states_a_third_of_the_noise_is_mapped_as_if_it_had_stated_all() -> None:
    """Without, its map is empty and 1.8 m wrong."""
    run, off = mapped_beginning("cluttered/lidar32/biased/noise0.3", 410000, 6)
    assert np.abs(off[:, :3, 3]).max() < 0.005
    assert len(run.planes) > 20 and run.rig.sensors["lidar"].range_sigma_m == pytest.approx(0.015, rel=0.1)


def test_ranges_of_a_2d_laser_tell_theirs() -> None:
    rng, angles = np.random.default_rng(8), np.linspace(-np.pi / 2, np.pi / 2, 181)
    walls = np.minimum(4.0 / np.maximum(np.cos(angles), 1e-9), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-9))
    rig, found = Rig(sensors={"front": Sensor(kind="line", range_sigma_m=0.005, range_max_m=30.0)}), []
    for _ in range(10):
        noise = 0.02 * rng.standard_normal((24, len(angles)))
        scans: list[Event] = [LaserScan(k, "front", walls + one, angles) for k, one in enumerate(noise)]
        found.append(with_shown_errors(Log(scans, Path("room")), rig).sensors["front"].range_sigma_m)
    assert np.mean(found) == pytest.approx(0.02, rel=0.04)  # 2,700 triples of beams tell it to 4 %
    assert np.std(found) < 0.06 * 0.02
