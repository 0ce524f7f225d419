"""Warp calibration: what a depth camera reads falsely at the same pixels of every image, learnt from planes it saw.

Walls are flat, whatever their place. In an image of a warped camera a plane is bent, and the next one, at other
pixels, as well: what the residuals of many planes agree on by the pixel is the camera's, and is taken off its ranges.
What averages over a plane does not, and no covariance could say how: planes turn with the camera, ahead of it, and a
map bends with every turn.

The mean residual of a plane over a cell of the image is its offset and tilt, which are its own, the warp there, noise,
and what its surface is uneven by (`spplanes.fitting.shared_error`). Waves of the warp are sought by generalised least
squares with normal priors of equal variance an octave, whose two variances maximise the evidence (empirical Bayes).
Uneven walls, and planes that are none, do not repeat by the pixel. Changes of inverse range that are linear in the
image map planes to planes, so that no flatness tells them: of what grows with the range those waves stay nought. Shares
that are linear in the image bend but planes seen aslant, a little: less than the pieces these fall into leave to be
seen. How far both may be off is as with the other waves, an octave's; it is kept with the warp (`left_open`), for
whoever makes a map (`slam.mapping.calibration_errors`).

References:
    Teichman, Miller, Thrun, "Unsupervised intrinsic calibration of depth sensors via SLAM", RSS 2013.
    MacKay, "Bayesian interpolation", Neural Computation 1992, for the evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from slam.frontend.measurement import for_points, for_sensor, usable_points
from slam.sensors.log import CloudScan, Log
from slam.sensors.rig import RangeWarp, Sensor, waves
from slam.sensors.scan_noise import model_of
from spplanes import MapperConfig
from spplanes._check import FloatArray
from spplanes.fitting.shared_error import MEAN_DISTANCE, SIGNIFICANCE, shared_error_of
from spplanes.segmentation.scans import label_scans

#: An image is cut into so many cells down and across; and waves down and across it, half as many.
_CELLS, _WAVES = (12, 16), (6, 8)


@dataclass(frozen=True, eq=False)
class _Cells:
    """A plane in an image, cell by cell."""

    points: FloatArray
    """Means of what is seen in each, shape (N, 3), m, in the camera's frame."""
    variances: FloatArray
    """Of these along the plane's normal, by the noise of the ranges, shape (N,), m^2."""
    waves: FloatArray
    """Of the warp there, those of a share and, times the range, those that grow with it, shape (N, 2 K)."""


def with_warp(name: str, sensor: Sensor, log: Log) -> Sensor:
    """A camera with the warp that planes of its images show; else the sensor, as one whose rig states a warp.

    Bent planes fall into pieces, which say less of long waves: they are looked for again without the warp seen so far
    while that puts pieces together.
    """
    if sensor.kind != "cloud" or sensor.warp is not None:
        return sensor
    images, warp, pieces = _images(log, name, sensor), None, np.inf
    for _ in range(6):  # looks
        planes = [plane for image in images for plane in _planes_in(image, sensor, warp)]
        if len(planes) >= pieces:
            break
        warp, pieces = warp_of(planes), len(planes)
        if warp is None:
            return sensor
    assert warp is not None
    spread = 100.0 * float(np.std(warp.over(*_CELLS).sum(axis=0)))
    log.notes.append(f"{name}: its images bend planes, by {spread:.2g} % of a range of 1 m: taken off")
    return sensor.model_copy(update={"warp": warp})


def _images(log: Log, name: str, sensor: Sensor) -> list[FloatArray]:
    """Points (H, W, 3) of 24 images of a camera, none of another sensor, thinned where they have many rows."""
    scans, found = [scan for scan in log.scans(name) if isinstance(scan, CloudScan)], []
    for index in np.unique(np.linspace(0, len(scans) - 1, 24).astype(int)).tolist() if scans else []:
        try:
            points = usable_points(scans[index].points, sensor)
        except ValueError:  # whoever measures them says what is unreadable
            continue
        if points.ndim != 3 or min(points.shape[:2]) < max(_CELLS):
            return []
        every = int(np.ceil(len(points) / 240))
        found.append(points[::every, ::every])
        if not _are_of_one_camera(found[0], found[-1]):
            return []
    return found


def _are_of_one_camera(image: FloatArray, other: FloatArray) -> bool:
    """Whether two grids of points have the same rays, and those are of a narrow view."""
    if image.shape != other.shape:
        return False
    with np.errstate(invalid="ignore"):
        rays = [points / np.linalg.norm(points, axis=-1, keepdims=True) for points in (image, other)]
    apart, seen = np.abs(rays[0] - rays[1]), other.reshape(-1, 3)[np.isfinite(other[..., 0]).ravel()]
    if not len(seen):
        return True
    turns = seen @ seen.mean(axis=0)
    most = np.deg2rad(60.0)  # from the middle of the image
    narrow = np.all(turns > np.cos(most) * np.linalg.norm(seen, axis=1) * np.linalg.norm(seen.mean(axis=0)))
    return bool(narrow and np.all(apart[np.isfinite(apart)] < 1e-3))


def _planes_in(points: FloatArray, sensor: Sensor, warp: RangeWarp | None) -> list[_Cells]:
    """The planes of an image (H, W, 3), those of enough cells, found with a warp taken off and with it still on."""
    straight = points if warp is None else warp.taken_off(points)
    settings = for_points(for_sensor(MapperConfig(), sensor), straight)
    found = label_scans(straight, model_of(sensor).covariances(straight), config=settings, viewpoints=np.zeros(3))
    height, width = found.labels.shape
    rows, columns = (np.arange(size) * cells // size for size, cells in zip((height, width), _CELLS, strict=True))
    cell = (rows[:, None] * _CELLS[1] + columns).ravel()
    down, across = (waves(size, count) for size, count in zip(_CELLS, _WAVES, strict=True))
    every = np.einsum("ri,cj->rcij", down, across).reshape(len(down) * len(across), -1)
    flat, labels, planes = points.reshape(-1, 3), found.labels.ravel(), []
    for label in range(int(labels.max(initial=-1)) + 1):
        members = np.flatnonzero(labels == label)
        numbers, own, count = np.unique(cell[members], return_inverse=True, return_counts=True)
        means = np.stack([np.bincount(own, flat[members, k]) for k in range(3)], axis=1) / count[:, None]
        full = count >= 0.1 * height * width / (_CELLS[0] * _CELLS[1])
        if np.count_nonzero(full) < 12:  # cells tell too little
            continue
        means, numbers = means[full], numbers[full]
        ranges, normal = np.linalg.norm(means, axis=1), _frame(means)[:3, 2]
        slant = np.maximum(np.square(means @ normal / ranges), 1e-3)  # however edge-on it is seen
        variances, own_waves = slant * sensor.range_variance_at(ranges) / count[full], every[numbers]
        planes.append(_Cells(means, variances, np.hstack((own_waves, own_waves * ranges[:, None]))))
    return planes


def _frame(points: FloatArray) -> FloatArray:
    """World_T_plane of points (N, 3), shape (4, 4)."""
    frame = np.eye(4)
    frame[:3, 3] = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov(points.T))
    frame[:3, :3] = np.column_stack((vectors[:, 2], vectors[:, 1], np.cross(vectors[:, 2], vectors[:, 1])))
    return frame


def warp_of(planes: Sequence[_Cells]) -> RangeWarp | None:
    """The warp that residuals of planes refuse to be without; None: there is none, or too little is seen."""
    if not planes:
        return None
    prior = _Prior.of_waves()
    best = _Warp(np.zeros(len(prior.variances)), 0.0, np.zeros(2))
    for _ in range(4):  # the unevenness of surfaces and the warp come to each other
        best = _likeliest(*_told(planes, best.weights), prior)
    if 2.0 * best.evidence < chdtri(2, SIGNIFICANCE):
        return None
    shares, per_m = (tuple(tuple(row) for row in part.tolist()) for part in best.weights.reshape(2, *_WAVES))
    left = _left_open(planes, np.where(prior.linear, prior.deviations(best.octaves), 0.0))
    return RangeWarp(shares=shares, shares_per_m=per_m, left_open=tuple(map(tuple, left.tolist())))


@dataclass(frozen=True, eq=False)
class _Prior:
    """Of the weights of all waves where the variance of an octave is one."""

    variances: FloatArray
    """Shape (2 K,)."""
    told: np.ndarray
    """Whether flat surfaces tell of a wave, shape (2 K,)."""
    linear: np.ndarray
    """Whether it is about linear in the image, or the same all over it, shape (2 K,)."""

    @classmethod
    def of_waves(cls) -> _Prior:
        """Of those over the image, and those times the range."""
        i, j = np.meshgrid(*(np.arange(count) for count in _WAVES), indexing="ij")
        square = (i**2 + j**2).ravel()
        told = np.concatenate((square > 0, square > 1))
        return cls(np.tile(1.0 / np.maximum(square, 1), 2), told, np.tile(square <= 1, 2))

    def deviations(self, octaves: FloatArray) -> FloatArray:
        """Of all weights by those of an octave, of waves that grow with the range and do not, shape (2 K,)."""
        return np.sqrt(self.variances) * np.repeat(octaves, len(self.variances) // 2)


@dataclass(frozen=True, eq=False)
class _Warp:
    """What residuals say of the waves."""

    weights: FloatArray
    """Shape (2 K,)."""
    evidence: float
    """Of these over that of none, a logarithm."""
    octaves: FloatArray
    """Standard deviations of an octave, of waves that grow with the range and do not, shape (2,)."""


def _left_open(planes: Sequence[_Cells], deviations: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the share linear in the ray, g . u, that weights of these deviations make of all planes."""
    waves = np.concatenate([plane.waves for plane in planes])
    rays = np.concatenate([plane.points / np.linalg.norm(plane.points, axis=1)[:, None] for plane in planes])
    effects = np.linalg.lstsq(rays, waves * deviations, rcond=None)[0]
    return effects @ effects.T


def _told(planes: Sequence[_Cells], weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information of the weights (2 K, 2 K) and that times them (2 K,), each plane as uneven as it is by now."""
    taken = [plane.points / (1.0 + plane.waves @ weights)[:, None] for plane in planes]
    frames = np.array([_frame(points) for points in taken])
    local = [(points - frame[:3, 3]) @ frame[:3, :3] for points, frame in zip(taken, frames, strict=True)]
    designs = [np.column_stack((np.ones(len(xyz)), -xyz[:, 0], xyz[:, 1])) for xyz in local]  # of offset and tilts
    spreads = [np.diag(by.T @ (by / plane.variances[:, None])) for by, plane in zip(designs, planes, strict=True)]
    shared = shared_error_of(
        np.concatenate(taken),
        np.concatenate([plane.variances for plane in planes])[:, None],
        np.repeat(np.arange(len(planes)), [len(plane.points) for plane in planes]),
        frames,
        np.array([np.diag(1.0 / spread) for spread in spreads]),
        stated=True,
    )
    information, told = np.zeros((len(weights), len(weights))), np.zeros(len(weights))
    for k, plane in enumerate(planes):
        off = (plane.points - frames[k, :3, 3]) @ frames[k, :3, 2]
        along = (plane.points @ frames[k, :3, 2])[:, None] * plane.waves
        noise = np.diag(shared.noise_factors[k] * plane.variances) + shared.octave_sigmas_m[k] ** 2 * _uneven(local[k])
        root = np.linalg.cholesky(noise)
        white = np.linalg.solve(root, np.column_stack((designs[k], along, off)))
        own, _ = np.linalg.qr(white[:, :3])
        rest = white[:, 3:] - own @ (own.T @ white[:, 3:])
        information += rest[:, :-1].T @ rest[:, :-1]
        told += rest[:, :-1].T @ rest[:, -1]
    return information, told


def _uneven(local: FloatArray) -> FloatArray:
    """Covariance of a surface's unevenness at points (N, 3) of it, with an octave of variance one, shape (N, N).

    Logarithms of distances are so but for a constant, which an offset takes up: so large as makes this a covariance.
    """
    apart = np.linalg.norm(local[:, None, :2] - local[:, :2], axis=-1)
    diameter = float(apart.max())
    side = np.sqrt(np.prod(np.ptp(local[:, :2], axis=0)) / len(local))
    return 10.0 + np.log2(diameter / np.hypot(apart, 2.0 * MEAN_DISTANCE * side))


def _likeliest(information: FloatArray, told: FloatArray, prior: _Prior) -> _Warp:
    """Weights by the likeliest deviations of an octave.

    Those of the parts that grow with the range and do not are looked for in turn, until neither gets likelier.
    """
    octaves = np.geomspace(1e-5, 0.1, 33).tolist()  # of one and 1/m
    best = _Warp(np.zeros(len(prior.variances)), 0.0, np.zeros(2))
    for _ in range(5):
        before = best.evidence
        for part in (0, 1):
            for octave in octaves:
                tried = np.where(np.arange(2) == part, octave, best.octaves)
                deviations = np.where(prior.told, prior.deviations(tried), 0.0)
                weights, evidence = _weighed(information, told, deviations)
                if evidence > best.evidence:
                    best = _Warp(weights, evidence, tried)
        if best.evidence == before:
            break
    return best


def _weighed(information: FloatArray, told: FloatArray, deviations: FloatArray) -> tuple[FloatArray, float]:
    """Weights with prior standard deviations (2 K,), and the evidence of these over that of none, a logarithm."""
    weights, used = np.zeros(len(deviations)), deviations > 0.0
    scale = deviations[used]
    lower = np.linalg.cholesky(np.eye(len(scale)) + scale[:, None] * information[np.ix_(used, used)] * scale)
    seen = np.linalg.solve(lower, scale * told[used])
    weights[used] = scale * np.linalg.solve(lower.T, seen)
    return weights, 0.5 * float(seen @ seen) - float(np.log(np.diag(lower)).sum())
