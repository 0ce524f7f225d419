"""Patches of a few points look every way by chance: what they seem to know of a motion by that is not believed."""

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.config import SlamConfig
from slam.frontend.scan_surfaces import ON_NO_PLANE, ON_PLANE
from slam.registration.surface_registration import LocalMap, align
from slam.registration.visibility import Scan
from slam.runs.slam_run import run_slam
from spplanes._check import FloatArray

SIGMA_M, WIDTH_M = 0.006, 0.085
#: How far off directions of patches are that are laid on points spread evenly over their width.
TILT_RAD = np.sqrt(12.0) * SIGMA_M / WIDTH_M


def rows(points: FloatArray, directions: FloatArray, kind: int, rng: np.random.Generator) -> FloatArray:
    """Elements at points (N, 3), each off along its direction by its noise."""
    count = len(points)
    noisy = points + SIGMA_M * rng.standard_normal((count, 1)) * directions
    numbers = np.tile((SIGMA_M, kind, WIDTH_M), (count, 1))
    return np.column_stack((noisy, directions, numbers))


def corridor(rng: np.random.Generator) -> list[FloatArray]:
    """Both walls and the floor, 2.4 m wide: they leave the way along x open."""
    parts = []
    for axis, place in ((1, -1.2), (1, 1.2), (2, -0.5)):
        points = rng.uniform((-4.0, -1.2, -0.5), (4.0, 1.2, 1.5), (400, 3))
        points[:, axis] = place
        direction = -np.sign(place) * np.eye(3)[axis]
        parts.append(rows(points, np.tile(direction, (400, 1)), ON_PLANE, rng))
    return parts


def patches(count: int, spread_rad: float, rng: np.random.Generator) -> FloatArray:
    """Bits of floor that no plane took, which look up but for a tilt."""
    points = np.column_stack((rng.uniform((-4.0, -1.2), (4.0, 1.2), (count, 2)), np.full(count, -0.5)))
    directions = np.column_stack((spread_rad * rng.standard_normal((count, 2)), np.ones(count)))
    return rows(points, directions / np.linalg.norm(directions, axis=1, keepdims=True), ON_NO_PLANE, rng)


def along_x(parts: list[FloatArray]) -> tuple[float, float]:
    """Standard deviation of the motion along x, m, with all else open and with all else known."""
    scan = Scan(np.vstack(parts), np.zeros(3))
    information = align(scan, LocalMap([(np.eye(4), scan)]), [np.eye(4)]).information + 1e-6 * np.eye(6)
    return float(np.linalg.inv(information)[3, 3] ** 0.5), float(information[3, 3] ** -0.5)


@pytest.mark.parametrize("seed", range(5))
def test_tilts_by_noise_do_not_hold_a_body_along_a_corridor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walls = corridor(rng)
    noisy, bare = along_x([*walls, patches(300, TILT_RAD, rng)]), along_x(walls)
    assert min(bare) > 100.0  # the test would say nothing of walls that hold it
    assert min(noisy) > 100.0
    rubble = patches(300, 0.8, rng)
    exact = rubble.copy()
    exact[:, 7] = ON_PLANE
    assert max(along_x([*walls, rubble])) < 1.5 * max(along_x([*walls, exact]))


@pytest.mark.parametrize("name, seed", [("bare/lidar64/absent/half", 170108), ("bare/lidar64/absent/fifth", 170068)])
def test_a_run_along_a_bare_corridor_without_odometry_says_that_nothing_told_its_way(name: str, seed: int) -> None:
    """They were 20 m off, sound, and sure of it to 6 cm."""
    drive = make_drive(Recipe.parse(name), seed)
    run = run_slam(drive.log, drive.rig, SlamConfig())
    assert run.verdict.verdict != "sound"
    assert any(one.kind == "assumption" and one.size > 1.0 for one in run.verdict.evidence)
