"""What of one view another is compared with: beams, rasters of returns and free space, bounds on blocks of motions."""

from collections.abc import Callable

import numpy as np
import pytest

from slam.frontend.information import left_open
from slam.frontend.occupancy.raster import CELL_M, NOVEL_SHARE, Raster, beams_of, moved
from slam.geometry.frames import planar_transform
from slam.registration.correlative_search import _UNIT, PlaceView, _widened, evidence_at, split
from slam.sensors.log import LaserScan
from tests.slam.laser_floors import FloorPlan, cast

ANGLES = np.linspace(-np.pi, np.pi, 361)


def room() -> FloorPlan:
    plan = FloorPlan()
    plan.add_chain([(-3.0, -2.0), (3.0, -2.0), (3.0, 2.0), (-3.0, 2.0), (-3.0, -2.0)])
    plan.add_box(0.8, -1.2, 0.6, 0.9)
    return plan


def corridor() -> FloorPlan:
    plan = FloorPlan()
    plan.walls = [((-30.0, -1.0), (30.0, -1.0)), ((30.0, 1.0), (-30.0, 1.0))]
    return plan


def view(plan: FloorPlan, pose: tuple[float, float, float], seed: int = 0) -> np.ndarray:
    """Beams (N, 4) of a full turn from a pose, in the frame of the pose."""
    walls = np.array(plan.walls)
    ranges = cast(walls, np.zeros((len(walls), 256)), np.array(pose), ANGLES)
    ranges += np.random.default_rng(seed).normal(0.0, 0.01, ANGLES.size)
    scan = LaserScan(0, "laser", np.where(ranges < 8.0, ranges, np.nan), ANGLES)
    return beams_of(scan, scan.ranges, np.eye(4))[0]


@pytest.mark.parametrize("plan", [room, corridor])
def test_a_block_bounds_all_motions_in_it(plan: Callable[[], FloorPlan]):
    """Also where a point lies beside the raster in the middle of a block, and in the raster at its edge."""
    a, b = (PlaceView(Raster.of(view(plan(), *look), 0.5)) for look in (((0.3, 0.1, 0.2), 3), ((0.0, 0.0, 0.0), 4)))
    rng, unit = np.random.default_rng(0), np.array((0.5 * CELL_M, 0.5 * CELL_M, 0.02))
    for level in (1, 2, 3, 4):
        blocks = np.column_stack((rng.integers(-160, 160, (400, 2)), rng.integers(-8, 8, 400))).astype(float)
        bounds, inside = evidence_at(a, b, blocks * unit, level), blocks
        for below in range(level, 0, -1):
            inside = split(inside, below)
        fits = evidence_at(a, b, inside * unit, 0).reshape(400, -1)
        assert (fits <= bounds[:, None] + _UNIT * 1e-6).all() and fits.shape[1] == 4**level


def test_a_raster_knows_occupied_free_and_unknown():
    raster = Raster.of(view(room(), (0.0, 0.0, 0.0)), 0.5)

    def at(x: float, y: float) -> float:
        column, row = np.floor((np.array((x, y)) - raster.origin) / CELL_M).astype(int)
        return float(raster.table[row, column])

    assert at(2.98, 0.5) > 2.0 and at(0.5, 0.4) == pytest.approx(np.log(NOVEL_SHARE))
    assert at(1.1, -0.8) == 0.0  # inside the box
    assert raster.weight == pytest.approx(0.2)


def test_widening_takes_the_largest_value_around_and_unknown_beyond_the_edge():
    table = np.full((5, 6), -1.0)
    table[2, 3] = 4.0
    wide = _widened(table, 1)
    assert (wide[1:4, 2:5] == 4.0).all() and wide[2, 1] == -1.0 and wide[0, 0] == 0.0


def test_a_leaning_laser_gives_no_beams_and_lone_returns_are_no_surface():
    scan = LaserScan(0, "laser", np.array((2.0, 2.0, 5.0, np.nan, 2.0)), np.radians((0.0, 1.0, 2.0, 3.0, 4.0)))
    lean = np.eye(4)
    lean[1:3, 1:3] = ((0.0, -1.0), (1.0, 0.0))
    assert beams_of(scan, scan.ranges, lean) == []
    (beams,) = beams_of(scan, scan.ranges, planar_transform(1.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(beams[0], (1.0, 0.0, 1.0, 2.0), atol=1e-12)
    assert len(beams) == 2
    np.testing.assert_allclose(moved(beams, planar_transform(0.0, 1.0, 0.0))[0], (1.0, 1.0, 1.0, 3.0), atol=1e-12)


def test_what_the_walls_say_already_is_taken_off():
    found, walls = np.diag((0.1, 0.02, 0.01)) ** 2, np.diag((100.0, 0.01, 0.005)) ** 2
    rest = left_open(found, walls)
    assert rest is not None and np.sqrt(rest[0, 0]) == pytest.approx(0.1, rel=0.01)
    assert min(rest[1, 1], rest[2, 2]) > 10.0 and left_open(found, 0.25 * found) is None
