"""Candidates by the index are those of looking at every landmark, whatever has moved, gone or come since."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.growth import mission
from slam import PlaneSlam
from slam.geometry import sphere_index
from slam.geometry.sphere_index import SphereIndex
from slam.map.landmarks import LandmarkMap


class Counted(SphereIndex):
    """Counts how often the tree is made."""

    packed = 0

    def _pack(self, numbers: np.ndarray, boxes: np.ndarray) -> None:
        self.packed += 1
        super()._pack(numbers, boxes)


def near(numbers: np.ndarray, middles: np.ndarray, radii: np.ndarray, place: np.ndarray, reach: float) -> list[int]:
    """By brute force."""
    return numbers[np.linalg.norm(middles - place, axis=1) <= radii + reach].tolist()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.01, 0.3, 5.0]))
def test_nothing_near_is_missed_while_spheres_move_go_and_come(seed: int, moved_m: float):
    rng = np.random.default_rng(seed)
    everywhere = {number: (40.0 * rng.random(3), 10.0 * rng.random() ** 4) for number in range(150)}
    here = set(range(0, 150, 2))
    index = SphereIndex()
    for _ in range(8):
        for number in rng.choice(150, 20):
            here ^= {int(number)}
        for number, (middle, radius) in everywhere.items():
            everywhere[number] = middle + moved_m * rng.standard_normal(3), radius * rng.uniform(1.0, 1.1)
        numbers = np.array(sorted(here))
        middles = np.array([everywhere[number][0] for number in numbers.tolist()])
        radii = np.array([everywhere[number][1] for number in numbers.tolist()])
        index.place(numbers, middles, radii)
        for _ in range(10):
            place, reach = 40.0 * rng.random(3), 3.0 * rng.random()
            about = index.about(place, reach)
            assert set(near(numbers, middles, radii, place, reach)) <= set(about)
            assert about == sorted(set(about))


def test_most_are_not_looked_at_and_the_tree_is_kept_while_they_hardly_move():
    rng = np.random.default_rng(0)
    index, numbers = Counted(), np.arange(5000)
    middles, radii = 200.0 * rng.random((5000, 3)), rng.random(5000)
    for _ in range(20):
        index.place(numbers, middles + 0.05 * rng.standard_normal((5000, 3)), radii)
    assert index.packed == 1
    assert 0 < len(index.about(middles[0], 5.0)) < 50
    index.place(numbers, middles + np.array([5.0, 0.0, 0.0]), radii)
    assert index.packed == 2


def test_what_is_nowhere_is_near_nothing():
    index, numbers = SphereIndex(), np.arange(100)
    middles = np.tile([1.0, 2.0, 0.0], (100, 1))
    middles[::2] = np.nan
    index.place(numbers, middles, np.ones(100))
    assert index.about(np.array([1.0, 2.0, 0.0]), 0.5) == list(range(1, 100, 2))
    assert SphereIndex().about(np.zeros(3), 1.0) == []


def test_an_office_is_mapped_by_the_same_decisions(monkeypatch: pytest.MonkeyPatch):
    frames = [frame for frame, _ in islice(mission(40, 3), 40)]

    def decided() -> list[list]:
        slam = PlaneSlam()
        return [slam.add_keyframe(frame).decisions for frame in frames]

    monkeypatch.setattr(sphere_index, "_BESIDE", 0)  # a map this small would be kept beside the tree
    by_index = decided()
    monkeypatch.setattr(LandmarkMap, "near", all_near)
    assert by_index == decided()
    assert sum(one.match is not None for decisions in by_index for one in decisions) > 300


def all_near(self, normal, middle, reach, max_angle):
    """`LandmarkMap.near` by looking at every landmark."""
    found = []
    for landmark in (one for one in self if one.id in self._rows):
        place, (centre, radius) = self.placed(landmark.id), self.sphere(landmark.id)
        if place.normal @ normal >= np.cos(max_angle) and np.linalg.norm(centre - middle) <= radius + reach:
            found.append((landmark, place))
    return found
