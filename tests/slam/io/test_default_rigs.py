"""Which rig a folder of clouds gets that comes with none."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.io.load import load
from tests.spplanes.scenes import spun, to_walls


def lines_of_a_room() -> np.ndarray:
    """What an upright laser sees that is turned through 120 lines in a room of 6 x 6 x 2.6 m, in the order it came."""
    rays = spun(np.linspace(-1.4, 1.4, 90), np.linspace(0.0, 3.0, 120)).swapaxes(0, 1).reshape(-1, 3)
    return rays * to_walls(rays, [-3.0, -3.0, -1.3], [3.0, 3.0, 1.3])[:, None]


def tilt_sigma_of(folder: Path) -> float:
    _, rig = load(folder)
    (sensor,) = rig.sensors.values()
    return sensor.plane_sigma_rad


def test_angles_of_a_turned_laser_are_trusted_less_than_those_of_a_spinning_one(tmp_path: Path):
    points = lines_of_a_room()
    in_order, mixed = tmp_path / "lines", tmp_path / "mixed"
    for folder, cloud in ((in_order, points), (mixed, np.random.default_rng(0).permutation(points))):
        folder.mkdir()
        np.save(folder / "0.npy", cloud)
        np.save(folder / "1.npy", cloud)
    assert tilt_sigma_of(in_order) > 3.0 * tilt_sigma_of(mixed) > 0.0


def test_a_first_cloud_that_cannot_be_read_does_not_keep_the_others_from_being_used(tmp_path: Path):
    np.save(tmp_path / "0.npy", np.full((100, 3), np.nan))
    np.save(tmp_path / "1.npy", lines_of_a_room())
    assert tilt_sigma_of(tmp_path) > 0.0
