"""Landmarks near a place are those of looking at one after the other."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from benchmarks.growth import mission
from slam import PlaneSlam
from slam.map.landmarks import LandmarkMap


def test_an_office_is_mapped_by_the_same_decisions(monkeypatch: pytest.MonkeyPatch):
    frames = [frame for frame, _ in islice(mission(40, 3), 40)]

    def decided() -> list[list]:
        slam = PlaneSlam()
        return [slam.add_keyframe(frame).decisions for frame in frames]

    at_once = decided()
    monkeypatch.setattr(LandmarkMap, "near", one_by_one)
    assert at_once == decided()
    assert sum(one.match is not None for decisions in at_once for one in decisions) > 300


def one_by_one(self, normal, middle, reach, max_angle):
    """`LandmarkMap.near` by looking at every landmark."""
    found = []
    for landmark in (one for one in self if one.id in self._rows):
        place, (centre, radius) = self.placed(landmark.id), self.sphere(landmark.id)
        if place.normal @ normal >= np.cos(max_angle) and np.linalg.norm(centre - middle) <= radius + reach:
            found.append((landmark, place))
    return found
