"""Readers against broken files and public functions against odd numbers, without the fuzzer: mutated valid inputs, and
those that once broke something.
"""

import importlib
import inspect
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
import shapely

from slam.session._codec import decode, encode
from tests.fuzz.mutating import by_form, floats
from tests.fuzz.public import CALLS, PUBLIC, WITHOUT_ARRAYS, seed_of
from tests.fuzz.target import folded
from tests.fuzz.targets import TARGETS
from tests.fuzz.wrapping import record, unrecorded


def _public(name: str, changed: dict[int, float]) -> tuple[str, bytes]:
    return "public", seed_of(list(CALLS).index(name), changed)


def _las_with(place: int, word: bytes) -> bytes:
    data = TARGETS["cloud.las"].seeds()[0]
    return data[:place] + word + data[place + len(word) :]


def _with(name: str, old: bytes, new: bytes, count: int = -1) -> tuple[str, bytes]:
    """The first valid input of a target with a part of it replaced."""
    return name, TARGETS[name].seeds()[0].replace(old, new, count)


def _array_of(name: str) -> bytes:
    size, data = struct.Struct("<I"), encode(np.arange(3.0)).replace(b"<f8", name.encode())
    return size.pack(size.unpack_from(data)[0] + len(name) - 3) + data[4:]


def _cloud_with(points: dict[int, tuple[float, float, float]]) -> bytes:
    data = TARGETS["fit"].seeds()[0]
    start = data.index(b"DATA binary\n") + 12
    numbers = np.frombuffer(data[start:], dtype="<f4").reshape(-1, 3).copy()
    for index, point in points.items():
        numbers[index] = point
    return data[:start] + numbers.tobytes()


def _numbered(*numbers: int) -> bytes:
    content = decode(record(TARGETS["prior-bytes"].seeds()[0]))
    planes = [replace(plane, id=number) for plane, number in zip(content["planes"], numbers, strict=False)]
    return unrecorded(encode({**content, "planes": planes, "covariance": 1e-4 * np.eye(3 * len(planes))}))


def _prior_of_arrays() -> bytes:
    """A plane whose chi2 is an array, of which numpy tells in several lines."""
    text, nul, arrays = TARGETS["prior-bytes"].seeds()[0].partition(b"\0")
    return text.replace(b'"chi2":0.0', b'"chi2":{"array":["<f8",[4,4],0,128]}', 1) + nul + arrays


def _aliases(last: str) -> bytes:
    """Ten billion numbers in eleven lines."""
    levels = [f"a{level}: &a{level} [{', '.join(10 * [f'*a{level - 1}'])}]" for level in range(1, 10)]
    return "\n".join([f"a0: &a0 [{', '.join(10 * ['1'])}]", *levels, last, ""]).encode()


def _session_with(change: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.db"
        path.write_bytes(TARGETS["session"].seeds()[0])
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("PRAGMA ignore_check_constraints = ON")
            connection.execute("PRAGMA writable_schema = ON")
            connection.execute("UPDATE sqlite_schema SET sql = replace(sql, ' NOT NULL', '')")
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(change)
        return path.read_bytes()


FAR_APART = {0: (10.377191, 19.603685, 110.74029), 28: (-0.047, 1.36e16, 3.0178), 29: (0, 2.079e11, 0)}
FAR_APART |= {30: (5.07e7, 12399.9, 0), 31: (0, 12392.3, 0)}
TAKEN_FOR_A_KEY, TOO_LONG = b"kind: line\n    " + b"1234 " * 200 + b": 1", b"0.0 depth/" + b"a" * 300 + b".png\n"
#: What broke a target once: its name and the input.
FOUND = {
    "a 3DTK scan of one beam": ("3dtk", b"1 2 3\n\x000 0 0\n0 0 0\n"),
    "points so far that their squares are infinite": _public("spplanes.segment_scans", {1: 1e308, 49: -1e200}),
    "points whose squares are zero": _public("spplanes.segment_scans", {1: 5e-324, 49: 1e-200}),
    "a 3DTK scan with a number as Python writes it": ("3dtk", b"100 200 300\n110 2001_0 300\n\x000 0 0\n0 0 0\n"),
    "a 3DTK scan beyond the squares of numbers": ("3dtk", b"10 2 0\n10 2000E200 2\n10 2 1\n\x000 0 0\n0 0 0\n"),
    "a time that overflows": ("tum", b"1E999999999999999999 0 0 0 0 0 0 1\n"),
    "records before the points of a LAS that would be gigabytes": ("cloud.las", _las_with(96, b"\xff" * 4)),
    "a prior with a plane of kilometres": _with("prior", b"3.0", b"3e18"),
    "planes whose frames are infinitely far": _public("spplanes.Plane.transform", {3: 1e200}),
    "a plane without a covariance": _public("spplanes.Plane.merge", {41: 1e-320, 45: 1e-320, 49: 1e-320}),
    "a keyframe whose noise is none": _public("slam.PlaneSlam.add_keyframe", {16: 1e-320}),
    "a keyframe whose motion is no number": _public("slam.PlaneSlam.add_keyframe", {41: 1e200}),
    "a factor without noise": _public("factors.plane_factor", {16: 1e-312}),
    "odometry without noise": _public("factors.odometry_factor", {3: 9.8e-91}),
    "noise whose square is infinite": _public("spplanes.segment_scans", {0: 1.3e253}),
    "noise whose inverse is infinite": _public("factors.parallel_factor", {0: 1e-310}),
    "a 3DTK scan whose lines only Python breaks": ("3dtk", b"\r" * 32 + b"1 2 0\0" + b"0 0 0\n0 0 0\n"),
    "a rotation whose squares are infinite": ("kitti", b".0 0.0 1.5 1.0 3e166 -1.0 0.0 1.5 0.0 0.0 1.0 1.0 "),
    "numbers of a session named by an expression": ("codec", _array_of(",f8")),
    "points so far apart that one alone is left of a plane": ("fit", _cloud_with(FAR_APART)),
    "an outline of arcs": ("codec", encode(shapely.Point(1, 2)).replace(b"\1\1\0\0\0", b"\1\x08\0\0\0")),
    "a prior with a plane that nobody knows": _with("prior", b"0.0,\n     1e-05,", b"0.0,\n     1.7e48,"),
    "a prior with two planes of one number": ("prior-bytes", _numbered(0, 0)),
    "a rig that takes its numbers for a key": _with("mission", b"kind: line", TAKEN_FOR_A_KEY, 1),
    "a list of depth images whose names are too long": ("depth", folded(b"525 525 8 6\n", TOO_LONG)),
    "a session whose checksum is none": ("session", _session_with("UPDATE keyframes SET digest = NULL WHERE id = 1")),
    "a rig with a number that is none": ("rig", b"sensors: !!int ''\n"),
    "a rig with a truth that is none": ("rig", b"sensors: !!bool x\n"),
    "a rig that holds itself": ("rig", b"sensors: &a\n  laser: *a\n"),
    "a configuration of aliases of aliases": ("config", _aliases("mapper: *a9")),
    "a rig of aliases of aliases": ("rig", _aliases("sensors: {laser: {kind: line, body_T_sensor: *a9}}")),
    "a graph with a normal whose square is infinite": _with("g2o", b"VERTEX_PLANE 2 0", b"VERTEX_PLANE 2 1e308"),
    "a cloud from a viewpoint whose square is infinite": _with("cloud.pcd", b"0 0 0 1 0 0 0", b"0 0 0 1e155 0 0 0"),
    "a prior whose number is an array": ("prior-bytes", _prior_of_arrays()),
    "noise whose square is zero": _public("spplanes.segment_scans", {0: 1e-200}),
}


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_valid_inputs_are_read(target, tmp_path: Path):
    assert any(target.run(seed, tmp_path) for seed in target.seeds())


@pytest.mark.parametrize(("name", "data"), FOUND.values(), ids=FOUND)
def test_what_was_found_stays_found(name: str, data: bytes, tmp_path: Path):
    TARGETS[name].run(data, tmp_path)


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_broken_inputs_are_an_answer_or_one_sentence(target, times, tmp_path: Path):
    seeds = target.seeds()
    change = floats if target.is_numbers else by_form
    for number in range(times(max(8, len(seeds)), 1000)):
        random, data = Random(number), seeds[number % len(seeds)]
        for _ in range(random.randrange(1, 4)):
            data = change(data, random)
        target.run(data, tmp_path)


def _public_names() -> Iterator[str]:
    """Of the three packages: functions, classes, and what a class can be asked to do."""
    for package in ("spplanes", "factors", "slam"):
        module = importlib.import_module(package)
        for name in module.__all__:
            found = getattr(module, name)
            yield f"{package}.{name}"
            if inspect.isclass(found):
                for member, value in vars(found).items():
                    if not member.startswith("_") and callable(getattr(found, member)) and not inspect.isclass(value):
                        yield f"{package}.{name}.{member}"


def test_every_public_function_is_fuzzed_or_takes_no_array():
    names = set(_public_names())
    listed = [{name.split(",")[0] for name in CALLS}, WITHOUT_ARRAYS]
    assert names - set.union(*listed) == set(), "say in tests/fuzz/public.py how to call them"
    assert set.union(*listed) - names == set(), "no longer public"
    assert sum(map(len, listed)) == len(set.union(*listed))


@pytest.mark.parametrize("number", range(len(CALLS)), ids=list(CALLS))
def test_what_it_takes_is_an_answer(number: int, tmp_path: Path):
    (target,) = PUBLIC
    assert target.run(seed_of(number), tmp_path)
