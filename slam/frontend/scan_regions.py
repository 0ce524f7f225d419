"""Regions of a 3D scan: points with all that the sensor errs in, and the plane they are believed to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from slam.config import BOUND_SIGMAS
from slam.sensors.rig import Sensor
from slam.sensors.scan_noise import model_of, servo_covariances, surface_covariances, tilt_drift
from spplanes import MapperConfig, Plane
from spplanes._check import FloatArray
from spplanes._rows import OK
from spplanes._threads import in_parts
from spplanes.fitting._groups import FitJob, fit_groups, group_by_label
from spplanes.fitting.shared_error import shared_error_of
from spplanes.segmentation.config import ValidationConfig
from spplanes.segmentation.validation.bends import surest_bend
from spplanes.segmentation.validation.one_plane import InPatches, could_be_seen, fits_its_noise
from spplanes.segmentation.validation.plane_ends import Window, sure_points
from spplanes.segmentation.validation.splitting import LIMIT, along_plane, are_spread, tells_tilt


class Regions(NamedTuple):
    """Regions that a segmentation found in a grid of a 3D scan's points, and what is asked of them."""

    points: FloatArray
    """In the sensor's frame, shape (S, B, 3), m."""
    covariances: FloatArray
    """Of their beams, shape (S, B, 3, 3), m^2."""
    labels: np.ndarray
    """Region of every point, shape (S, B); -1: none."""
    frames: FloatArray
    """About their planes, shape (R, 4, 4)."""
    sensor: Sensor
    """How it errs."""
    viewpoint: FloatArray
    """Where it was, shape (3,), m."""
    mapper: MapperConfig
    """How uneven surfaces are."""
    rules: ValidationConfig
    """What is believed to be a plane."""

    @property
    def window(self) -> Window:
        """The points, with poses that do not err."""
        return Window(self.points, self.covariances, np.empty((0, 0)))


class ScanPart:
    """Points of a region, with all that the sensor errs in."""

    def __init__(self, of: Regions, members: np.ndarray, frame: FloatArray) -> None:
        """Those with indices `members`, (N,), into the flat grid, about a plane of frame (4, 4)."""
        self.of, self.members, self._frame = of, members, frame
        self.points = of.points.reshape(-1, 3).take(members, 0)
        noise = of.covariances.reshape(-1, 3, 3).take(members, 0)
        self.noise = surface_covariances(self.points, noise, frame, of.sensor)
        self.blurred = servo_covariances(self.points, self.noise, members // of.labels.shape[1], of.sensor)

    def fitted(self) -> Plane | None:
        """The plane of the points, all errors counted; None where they do not determine one.

        Nothing is checked again: they come from a segmentation, which has looked at points and covariances.
        """
        job, n = FitJob(self.points, self.blurred, self.of.viewpoint), len(self.points)
        fits = fit_groups(job, np.arange(n), np.array([0, n]))
        return fits.planes()[0] if fits.status[0] == OK else None

    def only(self, chosen: np.ndarray) -> ScanPart:
        """The points of a mask (N,)."""
        return ScanPart(self.of, self.members[chosen], self._frame)


class Believed(NamedTuple):
    """A region that is a plane."""

    plane: Plane
    """What it is."""
    part: ScanPart
    """The points that are on it."""


def members_of(labels: np.ndarray, count: int) -> list[np.ndarray]:
    """Indices into the flat grid of the points of every plane, ascending, from labels (S, B)."""
    order, flat = np.argsort(labels, axis=None, kind="stable"), labels.ravel()
    return np.split(order, np.searchsorted(flat[order], np.arange(count + 1)))[1:-1]


def unambiguous(regions: Regions) -> Regions:
    """Regions without points that may be of another surface.

    Planes edge-on to the sensor are artefacts of a scan line, and end no other: beams meet them anywhere. They are seen
    from the middle of their points, not from where those are that weigh most: of a floor they are the farthest.
    """
    points, _, labels, frames = regions[:4]
    seen = [False]  # what is of no plane
    for frame, members in zip(frames, members_of(labels, len(frames)), strict=True):
        middle = points.reshape(-1, 3)[members].mean(axis=0)
        aside = abs(float(frame[:3, 3] @ frame[:3, 2]))
        seen.append(aside >= float(np.linalg.norm(middle)) * np.cos(regions.rules.max_incidence_rad))
    labels = np.where(np.array(seen)[labels + 1], labels, -1)
    sure = sure_points(regions.window, labels, list(frames), regions.mapper.flatness_m)
    return regions._replace(labels=np.where(sure, labels, -1))


def on_planes(regions: Regions) -> Regions:
    """Regions by where their points' beams meet the plane, not by what they read: without those that the sensor's
    limits may cut off, and with the noise of that place.

    Of a surface near a limit those returns are left that err to this side of it: near the 5 m of a depth camera planes
    came out 0.9 to 1.7 sigmas too near in four drives. And where noise grows with the range, those that read too little
    would count for more than those that read too much.
    """
    points, covariances, labels, frames, sensor = regions[:5]
    labels, (members,) = labels.copy(), np.nonzero(labels.ravel() >= 0)
    own, flat = labels.ravel(), points.reshape(-1, 3)[members]
    normals, origins = frames[own[members], :3, 2], frames[own[members], :3, 3]
    along, away = np.einsum("ki,ki->k", flat, normals), np.einsum("ki,ki->k", origins, normals)
    there = flat * np.divide(away, along, out=np.zeros(len(flat)), where=along * away > 0.0)[:, None]
    met = np.linalg.norm(there, axis=1)
    met = np.where(met < sensor.range_max_m, met, 0.0)  # a beam hardly meets a plane that it runs along
    margin = BOUND_SIGMAS * np.sqrt(sensor.range_variance_at(met))
    inside = (met > 0.0) & (met - margin > sensor.range_min_m) & (met + margin < sensor.range_max_m)
    own[members[~inside]] = -1
    model = model_of(sensor)
    if model.range_sigma_per_m2 > 0.0 and inside.any():
        covariances = covariances.copy()
        covariances.reshape(-1, 3, 3)[members[inside]] = model.covariances(there[inside])
    return regions._replace(labels=labels, covariances=covariances)


def well_conditioned(regions: Regions) -> Regions:
    """Those whose points tell the tilt of their plane."""
    labels = regions.labels.copy()
    for frame, members in zip(regions.frames, members_of(labels, len(regions.frames)), strict=True):
        if not tells_tilt(regions.window, members, frame, regions.mapper.max_tilt_rad):
            labels.ravel()[members] = -1
    return regions._replace(labels=labels)


def believed_planes(regions: Regions) -> list[list[Believed]]:
    """The planes of every region, fitted with all errors counted, those that residuals show as well.

    Returns:
        Of every region none, where it is no plane, or one, or those on either side of its bends, largest first.
    """
    numbers, order, bounds = group_by_label(regions.labels.ravel(), regions.labels.size)
    largest_first = np.argsort(-np.diff(bounds), kind="stable").tolist()
    found: list[list[Believed]] = [[] for _ in regions.frames]

    def measure(first: int, last: int) -> None:
        for k in largest_first[first:last]:
            one = believed_plane(ScanPart(regions, order[bounds[k] : bounds[k + 1]], regions.frames[numbers[k]]))
            found[numbers[k]] = [] if one is None else _parted(one)

    in_parts(measure, len(numbers), len(order), singly=True)
    shown = iter(_with_shared_error([plane for planes in found for plane in planes]))
    return [[next(shown) for _ in planes] for planes in found]


def _parted(one: Believed) -> list[Believed]:
    """The planes on either side of a bend of what was taken for one, largest first; that one where it has none."""
    sensor, _, mapper, rules = one.part.of[4:]
    places, residuals, weights = along_plane(one.part.points, one.part.blurred, one.plane.frame)
    bend = surest_bend(places, residuals, weights)
    if bend is None or not bend.is_sure(sensor.surface_sigma_m, rules.step_m, LIMIT):
        return [one]
    enough = [
        one.part.only(side)
        for side in bend.sides(places)
        if np.count_nonzero(side) >= mapper.min_points and are_spread(places[side], weights[side], mapper.max_tilt_rad)
    ]
    believed = [found for side in enough if (found := believed_plane(side)) is not None]
    planes = [part for found in believed for part in _parted(found)]
    return sorted(planes, key=lambda found: (-found.plane.n_points, int(found.part.members[0])))


def relabelled(
    regions: Regions, sure: np.ndarray, believed: Sequence[Sequence[Believed]]
) -> tuple[np.ndarray, np.ndarray]:
    """Number of the plane of every point, -2 in regions that are none, -1 elsewhere, and each plane's region, (P,).

    What was no part of the regions that were believed in, by their labels (S, B), goes with its region; of several
    planes with the nearest.
    """
    points, _, labels = regions[:3]
    counts = np.array([len(planes) for planes in believed], dtype=np.int64)
    first = np.cumsum(counts) - counts
    fresh = np.append(np.where(counts > 0, first, -2), -1)[labels]
    fresh[np.append(counts > 0, False)[sure]] = -1
    for k in np.flatnonzero(counts > 1).tolist():
        members = np.flatnonzero((labels.ravel() == k) & (fresh.ravel() >= 0))
        off = [np.abs(one.plane.distance(points.reshape(-1, 3)[members])) for one in believed[k]]
        fresh.ravel()[members] = first[k] + np.argmin(off, axis=0)
    for number, one in enumerate(chain.from_iterable(believed)):
        fresh.ravel()[one.part.members] = number
    return fresh, np.repeat(np.arange(len(believed)), counts)


def _with_shared_error(planes: Sequence[Believed]) -> list[Believed]:
    """The planes of a scan with the errors that their residuals have in common beyond what the sensor states."""
    if not planes:
        return []
    sizes = [len(plane.part.points) for plane in planes]
    shared = shared_error_of(
        np.concatenate([plane.part.points for plane in planes]),
        np.concatenate([plane.part.blurred for plane in planes]).reshape(-1, 9),
        np.repeat(np.arange(len(planes)), sizes),
        np.array([plane.plane.frame for plane in planes]),
        np.array([plane.plane.covariance for plane in planes]),
        stated=True,
    )
    return [
        plane._replace(plane=replace(plane.plane, covariance=covariance))
        for plane, covariance in zip(planes, shared.covariances, strict=True)
    ]


def believed_plane(part: ScanPart) -> Believed | None:
    """The plane of a region, if it is one; None: it is none.

    A plane is fitted anew without the patches that stray, which moves it and its patches: so a few times over, while
    nine tenths of its points are left.
    """
    rest, (sensor, viewpoint, _, rules) = part, part.of[4:]
    for _ in range(4):
        plane = rest.fitted()
        if plane is None:
            return None
        drift_m = tilt_drift(plane, rest.points, sensor) if sensor.tilt_sigma_rad > 0.0 else None
        patches = InPatches(plane, rest.points, rest.noise, rules, drift_m=drift_m)
        if could_be_seen(plane, viewpoint, rules) and fits_its_noise(plane, rules) and not patches.has_step:
            return Believed(plane, rest)
        chosen = patches.without_strays()
        if chosen is None or np.count_nonzero(chosen) < 0.9 * len(part.members):
            return None
        rest = rest.only(chosen)
    return None
