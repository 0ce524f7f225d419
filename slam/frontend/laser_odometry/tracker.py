"""Laser odometry, scan by scan: predict by wheels, match to the local map, learn what the wheels are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.config import CoastingConfig
from slam.frontend.deskewing import unswept
from slam.frontend.information import inverted
from slam.frontend.laser_odometry.local_map import LocalMap, Surface
from slam.frontend.laser_odometry.matching import Expected, Match, match_scan
from slam.frontend.laser_odometry.track import (
    LaserTrack,
    Step,
    between,
    between_scans,
    compose,
    matched_covariance,
    rotation,
)
from slam.frontend.laser_odometry.velocity import VelocityFilter, stamp_sigma
from slam.frontend.occupancy.raster import LEVEL_COSINE
from slam.frontend.odometry import Motion, OdometryTrack, difference, planar_delta
from slam.frontend.wheel_calibration import WheelCalibration
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import LaserScan, Log
from slam.sensors.rig import Rig
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray

#: A match is taken when the map has this share of the scan.
_LEAST_FIT = 0.3


class NoiseScale:
    """Factors on the variances of odometry's steps along, across and in heading: an inverse gamma of each.

    One step of expectation maximisation a step: with P the variance of the step before its end was seen, P' after, and
    e the correction, the wheels' squared error is expected to be e^2 + P'. The step counts by its share 1 - P' / P:
    what the returns leave open teaches nothing. A step that a Student t calls an outlier counts less.
    """

    def __init__(self) -> None:
        self._shape, self._rate = np.full(3, 4.0), np.full(3, 4.0)  # what is stated is worth so many steps

    @property
    def factors(self) -> FloatArray:
        """On the variances, shape (3,)."""
        return self._rate / self._shape

    def scaled(self, covariance: FloatArray) -> FloatArray:
        """A stated covariance (3, 3) of (x, y, theta), x along the motion, as the drive has shown it to be."""
        roots = np.sqrt(self.factors)
        return covariance * np.outer(roots, roots)

    def learn(self, error: FloatArray, stated: FloatArray, posterior: FloatArray, predicted: FloatArray) -> None:
        """Take in one step.

        Args:
            error: The step by wheels and returns together less that by the wheels, (x, y, theta), shape (3,).
            stated: Covariance of the wheels' random error as the rig states it, shape (3, 3).
            posterior, predicted: Covariance of the step after and before its end was seen, shape (3, 3).
        """
        stated_variance, before, after = np.diag(stated), np.diag(predicted), np.diag(posterior)
        gain = np.clip(1.0 - after / before, 0.0, 1.0)
        squared = error**2 + after
        weight = 5.0 / (4.0 + squared / before)  # of four degrees of freedom
        kept = 1.0 - gain / 150.0  # over so many steps what was learnt is forgotten
        self._shape = kept * self._shape + gain
        self._rate = kept * self._rate + gain * weight * squared / stated_variance


class LaserOdometry:
    """Turns scans and what the wheels said between them into poses."""

    def __init__(self, noise: OdometryNoise, coasting: CoastingConfig, stamp_sigma_s: float = 0.0) -> None:
        self._noise = noise
        self._velocity = VelocityFilter(coasting, stamp_sigma_s)
        self._map = LocalMap(())
        self._scale, self._calibration = NoiseScale(), WheelCalibration()
        self._fit = 0.9  # as usual, over some fifty scans
        self.steps: list[Step] = []
        self._since: list[FloatArray] = []
        self._key = 0

    def add(self, stamp_ns: int, surface: Surface, wheels: FloatArray | None) -> Step:
        """Take in a scan, and the motion (x, y, theta) from the one before by the wheels; None: nobody measured it."""
        if not self.steps:
            step = Step(stamp_ns, np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
            self._map = self._map.extended(surface, step.pose)
            self.steps.append(step)
            return step
        before = self.steps[-1].pose
        ways = self._ways(stamp_ns, wheels)
        turn = rotation(before[2])
        expected = [Expected(compose(before, delta), turn @ cov @ turn.T, share) for delta, cov, share in ways]
        match = self._match(surface, expected)
        pose, told, spread, used = expected[0].pose, np.zeros((3, 3)), np.zeros((3, 3)), 0
        if match.fit >= _LEAST_FIT:
            pose, told, used = match.pose, match.information, match.way
        if match.odds < 1.0:
            # it may be elsewhere: true of the way there and of what is seen, half of it said by each
            away = difference(match.pose, pose)
            spread = 2.0 * (match.spread + np.outer(away, away))
            told = inverted(inverted(told + 1e-3 * np.eye(3)) + spread)
        if len(self.steps) == 1:  # the first scan is the map: its noise is in the match of the second
            self.steps[0] = replace(self.steps[0], returns=told)
        (delta, covariance, _), back = ways[used], rotation(pose[2])
        step = Step(stamp_ns, pose, covariance, back.T @ told @ back)
        if wheels is None:
            kept = self._velocity.learn_unmeasured(*self._moved(step), (delta, covariance))
            step = replace(step, wheels=self._not_below_floor(kept))
        else:
            step = replace(step, slipped=used == len(ways) - 1)
            self._velocity.learn(*self._moved(step))
            self._since.append(wheels)
        self.steps.append(replace(step, wheels=step.wheels + turn.T @ spread @ turn))
        self._extend_map(surface, pose, match)
        return self.steps[-1]

    def _ways(self, stamp_ns: int, wheels: FloatArray | None) -> list[tuple[FloatArray, FloatArray, float]]:
        """How the body may have moved: the step (3,), its covariance (3, 3), and how probable that is."""
        seconds = 1e-9 * (stamp_ns - self.steps[-1].stamp_ns)
        delta, covariance = self._velocity.ahead(seconds)
        covariance = self._not_below_floor(covariance)
        if wheels is None:
            usual, kept, share = self._velocity.usually(seconds)
            return [(usual, self._not_below_floor(kept), share), (delta, covariance, 1.0 - share)]
        _, response, random = self._stated([wheels])
        learnt = self._calibration.covariance
        if learnt is None:
            learnt = np.diag(np.square(self._noise.calibration_sigmas))
        led = wheels + response @ self._calibration.mean
        known = self._scale.scaled(random) + response @ learnt @ response.T
        # once in a thousand steps wheels slip, or count wrong; once in twenty they err by four times what is known as
        # yet: of the first steps the rig alone knows
        slip, worse = 1e-3, 0.05
        return [(led, known, 1.0 - worse - slip), (led, 16.0 * known, worse), (delta, covariance, slip)]

    def _stated(self, steps: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The whole of steps, its response to the wheels' calibration, and its covariance without that."""
        whole, covariance = self._noise.accumulate(steps)
        response = self._noise.response(steps)
        return whole, response, covariance - response @ np.diag(np.square(self._noise.calibration_sigmas)) @ response.T

    def _not_below_floor(self, covariance: FloatArray) -> FloatArray:
        """A covariance (3, 3) of a step that nobody measured, with no variance below the least of any."""
        least = np.square((self._noise.floor_m, self._noise.floor_m, self._noise.floor_rad))
        return covariance + np.diag(np.maximum(least - np.diag(covariance), 0.0))

    def _moved(self, step: Step) -> tuple[float, FloatArray, FloatArray]:
        """Seconds of a step from the last one, where it led (3,), and the covariance (3, 3) of that by the returns."""
        before = self.steps[-1]
        moved = between(before.pose, step.pose)
        return 1e-9 * (step.stamp_ns - before.stamp_ns), moved, matched_covariance(before, step, moved)

    def _match(self, surface: Surface, expected: list[Expected]) -> Match:
        """Where the scan lies in the map; one that cannot be matched fits it nowhere."""
        if self._map.is_empty or len(surface.points) < 3:
            return Match(expected[0].pose, np.zeros((3, 3)), 0.0, 0.0, 0)
        match = match_scan(surface, self._map, expected, self._fit)
        self._fit += (np.clip(match.fit, 0.5, 0.98) - self._fit) / 50.0
        return match

    def _extend_map(self, surface: Surface, pose: FloatArray, match: Match) -> None:
        """Add the scan to the map when the body has come far enough, and learn from the way since the last one."""
        moved = between(self._map.scans[-1][1], pose)
        if np.hypot(*moved[:2]) < 0.25 and abs(moved[2]) < 0.3:  # m and rad
            return
        if match.fit >= _LEAST_FIT and match.odds < 0.9:  # it may lie elsewhere
            return
        if len(surface.points):
            self._map = self._map.extended(surface, pose)
        self._learn()

    def _learn(self) -> None:
        """What the way between the last two scans of the map says about the wheels."""
        first, last = self._key, len(self.steps) - 1
        self._key, since, self._since = last, self._since, []
        if not since or len(since) != last - first:
            return
        whole, response, random = self._stated(since)
        estimate = between(self.steps[first].pose, self.steps[last].pose)
        matched = inverted(matched_covariance(self.steps[first], self.steps[last], estimate))
        sigmas = self._noise.calibration_sigmas
        stated = random + response @ np.diag(np.square(sigmas)) @ response.T
        motion = Motion(planar_transform(*whole), stated, (1.0, 1.0, 1.0), response, sigmas)
        predicted = self._calibration.predict(motion)
        known = predicted.covariance - random + self._scale.scaled(random)
        posterior = inverted(inverted(known) + matched)
        error = estimate - planar_delta(predicted.a_T_b)
        self._calibration.learn(replace(predicted, covariance=known), planar_transform(*estimate), posterior)
        self._scale.learn(error, random, posterior, known)


def laser_track(log: Log, rig: Rig, coasting: CoastingConfig) -> LaserTrack | None:
    """Laser odometry over all scans of the lasers of a log that look along the floor, upside down or not; None: none.

    What moves within a scan is told by the wheels.
    """
    lasers = rig.of_kind("line").items()
    sensors = {name: sensor for name, sensor in lasers if abs(sensor.body_T_sensor[2, 2]) >= LEVEL_COSINE}
    scans = [one for one in log.scans() if isinstance(one, LaserScan) and one.sensor in sensors]
    if not scans:
        return None
    readings = log.measured_motion
    track = OdometryTrack(readings, rig.odometry) if readings else None
    wheels = None if track is None else track.poses_at([scan.stamp_ns for scan in scans])
    by_sensor = [[scan.stamp_ns for scan in scans if scan.sensor == name] for name in sensors]
    odometry = LaserOdometry(rig.odometry, coasting, max(map(stamp_sigma, by_sensor), default=0.0))
    last = -1
    for index, scan in enumerate(scans):
        if last >= 0 and scan.stamp_ns <= scans[last].stamp_ns:
            continue
        delta = None
        if wheels is not None and last >= 0:
            delta = planar_delta(inverse(wheels[last]) @ wheels[index])
        sensor = sensors[scan.sensor]
        at_once = scan if track is None else unswept(scan, sensor, track)
        odometry.add(scan.stamp_ns, Surface.of(at_once, sensor), delta)
        last = index
    return LaserTrack(odometry.steps, rig.odometry, between_scans(odometry.steps, track))
