"""Range noise that scans show: how far beams scatter about the surfaces that they are on.

What a rig states too little of leaves no plane to be found and no match to be made. Scans tell it before anything is
estimated. Those of 2D lasers by their lines (`slam.sensors.scan_noise`). In 3D scans beams next to each other do: on a
plane the inverse range of one follows from those of its neighbours, whatever the plane, so that what they miss it by is
their noise. That is the least error a beam can have; what neighbours share is not in it. So a rig is never believed to
have less, and one that states more is believed.

What cameras read falsely by the pixel is looked for after it, with noise that holds (`slam.frontend.warp_calibration`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from weakref import WeakKeyDictionary

import numpy as np

from slam.frontend.measurement import in_rows, usable_points
from slam.frontend.warp_calibration import with_warp
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.sensors.rig import Rig, Sensor
from slam.sensors.scan_noise import shown_by_lines, with_beam_sigma
from spplanes._check import FloatArray
from spplanes.clouds.scatter import misses_of

#: What a rig states is refuted by so many times as much. In honest drives through 11 kinds of buildings, cluttered ones
#: among them, scans of five kinds of sensors show 0.86 to 1.05 times what is stated.
_REFUTED = 1.2

#: Rigs looked at already, by their log: what was given, and what came of it.
_KNOWN: WeakKeyDictionary[Log, tuple[Rig, Rig]] = WeakKeyDictionary()


def with_shown_errors(log: Log, rig: Rig) -> Rig:
    """The rig with no less range noise than its scans show, and the warp that images of its cameras show.

    Where that is more than it states, with a note in the log.
    """
    known = _KNOWN.get(log)
    if known is not None and any(rig is one for one in known):
        return known[1]
    sensors = {name: with_warp(name, _raised(name, sensor, log), log) for name, sensor in rig.sensors.items()}
    changed = any(sensors[name] is not rig.sensors[name] for name in sensors)
    result = rig.model_copy(update={"sensors": sensors}) if changed else rig
    _KNOWN[log] = (rig, result)
    return result


def _raised(name: str, sensor: Sensor, log: Log) -> Sensor:
    """The sensor, or where its beams scatter by more than it states, one that states as much."""
    scans = log.scans(name)
    if not scans:
        return sensor
    if isinstance(scans[0], LaserScan):
        seen_m = shown_by_lines(sensor, scans)  # it is stated with uneven surfaces
        refuted = seen_m is not None and seen_m > _REFUTED * sensor.beam_sigma_m
        result = with_beam_sigma(sensor, seen_m) if refuted else sensor
    else:
        result = _as_clouds_show(sensor, scans)
    if result is not sensor:
        stated, seen = 1e3 * sensor.range_sigma_m, 1e3 * result.range_sigma_m
        note = f"{name}: ranges scatter about surfaces by {seen:.3g} mm where {stated:.3g} mm are stated: taken as seen"
        log.notes.append(note)
    return result


def _as_clouds_show(sensor: Sensor, scans: Sequence[LaserScan | CloudScan]) -> Sensor:
    grids, result = [], sensor
    for index in np.unique(np.geomspace(1.0, len(scans), 6).astype(int)) - 1:  # the first rather than the last
        with suppress(ValueError):  # whoever measures them says what is unreadable
            grids.append(in_rows(usable_points(scans[index].points, sensor), sensor))
    for _ in range(5):  # the noise of the beams comes to what is seen beside the parts of the rig's noise that stay
        factor = noise_factor(grids, result)
        if factor is None or factor <= (_REFUTED if result is sensor else 1.0):
            break
        beams = "range_sigma_m", "disparity_sigma_per_m"  # the noise of single beams: the parts that do not stay
        result = result.model_copy(update={name: factor * getattr(result, name) for name in beams})
    return result


def noise_factor(grids: list[FloatArray], sensor: Sensor) -> float | None:
    """How many times the noise that a sensor states its beams scatter by; None where too little is seen.

    Grids are points of scans, each (S, B, 3) with neighbours in a row, m, in the sensor's frame; NaN = no return.
    """
    seen = [np.empty(0), *(_normalised(grid, sensor) for grid in grids)]
    missed = np.abs(np.concatenate(seen))
    if len(missed) < 500:  # they say nothing
        return None
    # edges, clutter and curved things add large misses, which the least quarter hardly sees: within so many sigmas
    return float(np.quantile(missed, 0.25)) / 0.31863936396437514


def _normalised(grid: FloatArray, sensor: Sensor) -> FloatArray:
    """What beams miss the planes through their neighbours by, in standard deviations of the sensor's noise, (N,)."""
    missed = misses_of(grid)
    ranges = np.linalg.norm(grid, axis=-1)
    here = ranges[:, 1:-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = grid / ranges[..., None]
        turned = np.linalg.norm(rays[:, 2:] - rays[:, :-2], axis=-1)
        tangent = np.abs(ranges[:, 2:] - ranges[:, :-2]) / (here * turned)
        used = np.isfinite(missed) & (tangent < 2.0)  # steeper beams tell the unevenness of a surface
    square = np.square(tangent[used])
    variance = sensor.range_variance_at(here[used]) + sensor.surface_sigma_m**2 * (1.0 + square)
    return missed[used] / np.sqrt(variance + np.square(here[used] * sensor.bearing_sigma_rad) * square)
