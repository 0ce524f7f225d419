"""Measurements that are read as they were written, and those that are not: what `encode_and_compare` says of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from factors.association.observations import LineObservation
from slam import PlaneSlam, SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.sensors.log import StoredScan
from slam.session._codec import decode, encode_and_compare, without_scans
from slam.simulation import simulate_mission
from spplanes import Plane, ScanLine
from tests.slam.scenes import drive


@pytest.mark.parametrize("world", ["office", "corridor"])
def test_what_is_said_to_be_read_as_it_was_is(world: str):
    """The estimator works with the measurements as they will be read: those that are the same are not read for it."""
    mission = simulate_mission(world, n_scans=30, seed=0)
    for keyframe in keyframes_of(mission.log, mission.rig, SlamConfig()):
        values = without_scans(keyframe)
        data, same = encode_and_compare(values)
        assert same and _is_same(decode(data), values)


def _is_same(a: object, b: object) -> bool:
    """Type by type and bit by bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.flags.c_contiguous and b.flags.c_contiguous and a.tobytes() == b.tobytes()
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_is_same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return _is_same(list(a.items()), list(b.items()))
    if isinstance(a, shapely.Geometry) and isinstance(b, shapely.Geometry):
        return shapely.to_wkb(a) == shapely.to_wkb(b)
    return _is_same(vars(a), vars(b)) if hasattr(a, "__dict__") else repr(a) == repr(b)


_LINE = ScanLine(0.3, 2.0, 1e-4 * np.eye(2), np.eye(2), np.arange(3))


@pytest.mark.parametrize(
    "value",
    [
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(12.0)[::2],
        np.arange(3, dtype=">f8"),
        np.float64(0.1),
        range(3),
        shapely.LinearRing([(0, 0), (1, 0), (1, 1)]),
        Plane._trusted(np.eye(4), np.array([[1.0, 1e-9, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 3),
        ScanLine._trusted(4.0, 2.0, _LINE.covariance, _LINE.endpoints, _LINE.indices, 0.0, 1),
        ScanLine._trusted(0.3, 2.0, _LINE.covariance, _LINE.endpoints, np.arange(3, dtype=np.int32), 0.0, 1),
        StoredScan({"stamp_ns": 0, "sensor": "laser", "angles": np.zeros(3)}, {"ranges": lambda _: np.ones(3)}),
    ],
    ids=str,
)
def test_what_is_read_as_something_else_is_not_said_to_be_the_same(value: object):
    data, same = encode_and_compare({"value": [value]})
    assert not same and not _is_same(decode(data)["value"][0], value)


def _seen(**line: Any) -> LineObservation:
    return LineObservation(replace(_LINE, **line), np.eye(4))


@pytest.mark.parametrize(
    "change",
    [
        {"notes": "dusty"},
        {"notes": (1,)},
        {"observations": [_seen(dof=8.0)]},
        {"observations": [_seen(dof=np.float64(8))]},
        {"observations": [_seen(chi2=np.array(8.0))]},
        {"observations": [_seen(dof=np.int64(8))]},
        {"observations": (_seen(),)},
        {"returns": np.zeros((2, 4), dtype=bool)},
        {"returns": np.zeros((2, 4), dtype=int)},
        {"notes": ("dusty",)},
    ],
    ids=str,
)
def test_a_session_holds_nothing_that_it_cannot_read(change: dict[str, Any], tmp_path: Path):
    """A keyframe is accepted and read again, or refused with a sentence and leaves no trace."""
    first, second, third = drive(0, count=3).keyframes
    with PlaneSlam.open(tmp_path / "session.db", SlamConfig()) as slam:
        slam.add_keyframe(first)
        try:
            slam.add_keyframe(replace(second, **change))
        except ValueError as error:
            assert "\n" not in str(error)
        count = len(slam.keyframes)
        slam.add_keyframe(third)
    with PlaneSlam.open(tmp_path / "session.db") as again:
        assert len(again.keyframes) == count + 1
        assert again.keyframes[count].stamp_ns == third.stamp_ns
