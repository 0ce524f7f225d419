"""A extent in tiles is the union of what it was grown by."""

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, box
from shapely.geometry.base import BaseGeometry

from slam.geometry.polygons import coarse
from spplanes.outlines.extents import _AT_ONCE, Extent, all_valid, grow, grow_all


def scattered(seed: int, count: int = 60) -> list[BaseGeometry]:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-9.0, 9.0, (count, 2))
    return [box(*corner, *(corner + size)) for corner, size in zip(low, rng.uniform(0.2, 3.0, (count, 2)), strict=True)]


def grown(patches: list[BaseGeometry]) -> Extent:
    extent = Extent(patches[0])
    for patch in patches[1:]:
        extent.grow(patch)
    return extent


def test_the_whole_is_the_union_to_the_tolerance_of_outlines():
    patches = scattered(0)
    extent, union = grown(patches), shapely.union_all(patches)
    assert extent.geometry.symmetric_difference(union).area < 0.005 * union.area
    assert shapely.hausdorff_distance(extent.geometry, union) < 0.05
    np.testing.assert_allclose(extent.bounds, union.bounds)
    assert len(shapely.get_parts(extent.geometry)) == len(shapely.get_parts(union))


def test_to_look_at_a_region_changes_nothing_of_it():
    seen, unseen = Extent(scattered(4)[0]), Extent(scattered(4)[0])
    for patch in scattered(4)[1:]:
        for extent in (seen, unseen):
            extent.grow(patch)
        assert seen.geometry.area > 0.0
    assert seen.geometry.equals_exact(unseen.geometry, 0.0)
    assert all(one.equals_exact(other, 0.0) for one, other in zip(seen.pieces, unseen.pieces, strict=True))


def test_near_is_what_is_near_the_union():
    patches, answers = scattered(1, 12), []
    extent, union = grown(patches), shapely.union_all(patches)
    for probe in (shapely.affinity.translate(one, 0.0, 17.0) for one in scattered(2, 80)):
        distance = union.distance(probe)
        assert extent.is_within(distance + 0.02, probe)
        if distance > 0.05:
            assert not extent.is_within(distance - 0.02, probe)
            answers.append(distance)
    assert len(answers) > 20
    assert extent.is_within(1e3, Point(500.0, 0.0)) and not extent.is_within(1e2, Point(500.0, 0.0))


def test_lines_of_one_wall_stay_one_segment():
    extent = grown([LineString([(0.0, 0.0), (1.0, 0.0)]), LineString([(3.0, 0.01), (8.0, 0.0)])])
    assert extent.geometry.geom_type == "LineString"
    np.testing.assert_allclose(extent.geometry.length, 8.0, atol=1e-3)


def test_a_line_and_a_patch_are_kept_both():
    extent = grown([LineString([(0.0, 0.5), (7.0, 0.5)]), box(1.0, 0.0, 3.0, 1.0)])
    assert abs(sum(part.area for part in shapely.get_parts(extent.geometry)) - 2.0) < 1e-9
    assert extent.is_within(0.1, Point(6.5, 0.5))
    np.testing.assert_allclose(extent.bounds, (0.0, 0.0, 7.0, 1.0))


def test_the_distance_of_a_patch_is_that_of_the_whole_up_to_a_bound():
    extent = Extent(box(0.0, 0.0, 5.0, 1.0))
    assert extent.distance(box(4.0, 0.5, 9.0, 2.0), 1.5) == 0.0
    assert np.isclose(extent.distance(box(5.7, 0.0, 6.0, 1.0), 1.5), 0.7, atol=0.01)
    assert extent.distance(box(7.0, 0.0, 8.0, 1.0), 1.5) == 1.5
    line = Extent(LineString([(0.0, 0.0), (3.0, 0.0)]))
    assert np.isclose(line.distance(LineString([(1.0, 0.4), (2.0, 0.4)]), 1.5), 0.4)
    assert line.distance(LineString([(1.0, 9.0), (2.0, 9.0)]), 1.5) == 1.5


def test_what_was_seen_before_changes_nothing():
    extent = grown([box(0.0, 0.0, 9.0, 9.0), *(_AT_ONCE - 1) * [box(1.0, 1.0, 7.5, 8.0)]])
    before = extent.pieces
    for _ in range(_AT_ONCE):
        extent.grow(box(1.0, 1.0, 7.5, 8.0))
    assert all(after is piece for after, piece in zip(extent.pieces, before, strict=True))
    extent.grow(box(8.0, 8.0, 9.5, 9.0))
    np.testing.assert_allclose(extent.geometry.area, 81.5, atol=1e-6)


@pytest.mark.parametrize(("radius", "allowed"), [(5.0, 0.1), (0.2, 0.0072)])
def test_an_outline_measured_keeps_the_corners_its_size_needs(radius: float, allowed: float):
    angles = np.linspace(0.0, 2.0 * np.pi, 600, endpoint=False)
    wavy = radius * (1.0 + 0.005 * np.sin(150.0 * angles))
    outline = shapely.Polygon(np.stack((wavy * np.cos(angles), wavy * np.sin(angles)), axis=1))
    [few] = coarse([outline])
    assert shapely.get_num_coordinates(few) < 60 and shapely.hausdorff_distance(few, outline) <= allowed
    assert abs(few.area / outline.area - 1.0) < 0.02


def test_outlines_that_grow_together_grow_as_alone():
    outlines = [*scattered(3, 30), LineString([(0, 0), (1, 0)])]
    bow_tie = shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 2)])
    patches = [*(box(*one.buffer(0.3).bounds) for one in outlines[:-2]), bow_tie, LineString([(0.5, 0), (3, 0.1)])]
    outlines[0] = outlines[0].buffer(5.0)  # covers its patch
    grown = grow_all(all_valid(outlines), patches)
    assert list(grown)[:2] == [1, 2] and len(grown) == 30
    for k, one in grown.items():
        assert one.equals_exact(grow(outlines[k], patches[k]), 0.0)


def test_a_corner_that_pokes_into_a_tile_by_less_than_a_rounding_is_taken_in():
    """The fast clipping of GEOS throws at it; corners of outlines lie on a raster, as the borders of tiles do."""
    poking = 0.049999999999999906
    corners = [(poking, -2.75), (0.7, -6.85), (0.7, -12.0), (-1.0, -12.0), (-1.0, -11.0), (0.2, -11.0), (0.2, -4.75)]
    patch = shapely.Polygon(corners)
    with pytest.raises(shapely.errors.GEOSException):
        shapely.clip_by_rect(patch, -2.05, -20.0, 0.05, 20.0)
    assert Extent(patch).geometry.symmetric_difference(patch).area < 1e-6
