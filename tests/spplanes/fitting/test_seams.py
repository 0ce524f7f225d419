"""Where planes meet, and where slanted beams meet them: what noise decides must not bend a plane."""

import numpy as np

from spplanes import segment_cloud
from spplanes.fitting.seams import along_beams, at_seams, placed

NOISE_M = 0.02
#: Floor z = 0 and wall y = 0 of 2 m by 1 m, that meet along x.
FLOOR, WALL = np.eye(4), np.eye(4)
WALL[:3, :3] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]


def test_points_that_go_over_at_a_seam_are_left_out_and_no_others_bend_a_plane():
    """Points err along normals: those that come over lie inside, L sigma^2 / 2A = 0.2 mm in the mean."""
    rng, count = np.random.default_rng(0), 400_000
    places = rng.uniform((-1.0, 0.0), (1.0, 1.0), (2, count, 2))
    points = np.zeros((2, count, 3))
    points[0, :, :2], points[1, :, 0], points[1, :, 2] = places[0], places[1, :, 0], places[1, :, 1]
    points[0, :, 2] = NOISE_M * rng.normal(size=count)
    points[1, :, 1] = NOISE_M * rng.normal(size=count)
    labels = np.where(np.abs(points[..., 2]) <= np.abs(points[..., 1]), 0, 1)
    seam = at_seams(points, np.full((2, count, 1), NOISE_M**2), labels, np.array([FLOOR, WALL]))
    for k, axis in ((0, 2), (1, 1)):
        every, sure = points[labels == k, axis], points[(labels == k) & ~seam, axis]
        error = NOISE_M / np.sqrt(len(sure))
        assert abs(every.mean() - NOISE_M**2 / 2.0) < 4.0 * error
        assert every.mean() > 4.0 * error
        assert abs(sure.mean()) < 3.5 * error
        assert len(sure) > 0.9 * len(every)


def test_slanted_beams_turn_no_plane():
    """A floor seen along beams at 3 in 4: without their places its slope is -sigma^2 (sin cos) / var x."""
    rng, count = np.random.default_rng(1), 100_000
    eyes = np.array([[[0.0, 0.0, 1.0]]])
    true = np.stack((rng.uniform(1.0, 2.0, count), rng.uniform(-0.3, 0.3, count), np.zeros(count)), axis=1)[None]
    beams = (true - eyes) / np.linalg.norm(true - eyes, axis=2, keepdims=True)
    points = true + NOISE_M * rng.normal(size=(1, count, 1)) * beams
    labels = np.zeros((1, count), dtype=np.int64)
    moved = placed(points, along_beams(points, eyes), labels, FLOOR[None])
    np.testing.assert_array_equal(moved[..., 2], points[..., 2])
    np.testing.assert_allclose(moved[..., :2], true[..., :2], atol=4e-3)
    slopes = [np.polyfit(some[0, :, 0], some[0, :, 2], 1)[0] for some in (points, moved)]
    error = np.std(points[..., 2]) / np.sqrt(count / 12.0)
    expected = NOISE_M**2 * (beams[..., 0] * beams[..., 2]).mean() * 12.0
    assert abs(slopes[0] - expected) < 4.0 * error
    assert abs(expected) > 6.0 * error
    assert abs(slopes[1]) < 4.0 * error


def test_walls_in_a_depth_image_are_no_nearer_than_they_are():
    """A corner of a room, noise that grows with the square of the range: what reads too little counts for no more."""
    rows, columns = np.meshgrid(np.linspace(-0.45, 0.45, 120), np.linspace(-0.6, 0.6, 160), indexing="ij")
    beams = np.stack((np.ones(rows.shape), columns, rows), axis=2)
    turned = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, np.sqrt(2.0)]]) / np.sqrt(2.0)
    sides = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    depth = (np.array([3.0, 2.6, 1.2]) / np.maximum(beams @ turned.T @ sides.T, 1e-9)).min(axis=2)
    distances = dict(zip(map(tuple, sides.tolist()), (3.0, 2.6, 1.2), strict=True))
    inward = []
    for seed in range(12):
        noise = 0.01 * (depth / 3.0) ** 2 * np.random.default_rng(seed).normal(size=depth.shape)
        planes = segment_cloud(((depth + noise)[..., None] * beams) @ turned.T)[1]
        for plane in planes:
            side, distance = next((side, d) for side, d in distances.items() if abs(plane.normal @ side) > 0.99)
            inward.append((distance - plane.centre @ side) / np.sqrt(plane.covariance[0, 0]))
    assert len(inward) == 36
    assert abs(np.mean(inward)) < 3.5 / np.sqrt(len(inward))
    assert np.mean(np.square(inward)) < 1.9
