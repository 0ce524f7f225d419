"""Input checks: keyframes that cannot be one, sensors that fall silent, 3D sensors that hang."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from shapely.geometry.base import BaseGeometry

from factors.association.observations import Observation, PlaneObservation
from slam._field_types import check_fields
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.geometry.frames import are_apart
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from spplanes._check import FloatArray, as_shape, as_transform, check_instance

#: Poses lie within this of where they are measured from, planes within that of their own middle, m.
_FARTHEST_M, _LARGEST_PLANE_M = 1e7, 2e3
#: Standard deviations that the graph can tell from none and from ignorance, m and rad.
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-9, 1e9


class KeyframeError(ValueError):
    """A keyframe that is refused before anything is done with it; the sentence says what is wrong with it."""


def check_keyframe(keyframe: Keyframe, after_ns: int | None, index: int) -> None:
    """Refuse what would leave the graph half changed.

    Raises:
        KeyframeError: a time not after `after_ns`, a covariance that is none: of the motion, or of what was seen; a
            match with a place that is not before `index`; and what is no keyframe at all.
    """
    try:
        _check_keyframe(keyframe, after_ns, index)
    except ValueError as error:
        raise KeyframeError(str(error)) from error


def _check_keyframe(keyframe: Keyframe, after_ns: int | None, index: int) -> None:
    check_instance("keyframe", keyframe, Keyframe)
    if not isinstance(keyframe.stamp_ns, int | np.integer):
        raise ValueError(f"keyframe.stamp_ns: expected whole nanoseconds, got {keyframe.stamp_ns!r}")
    check_instance("keyframe.observations", keyframe.observations, Sequence)
    if after_ns is not None and keyframe.stamp_ns <= after_ns:
        raise ValueError(f"keyframe: expected a time after {after_ns} ns, got {keyframe.stamp_ns} ns")
    if keyframe.motion is not None:
        check_instance("keyframe.motion", keyframe.motion, Motion)
        check_fields("keyframe.motion", keyframe.motion)
        _check_covariance("keyframe.motion.covariance", keyframe.motion.covariance, (3, 6))
        _check_pose("keyframe.motion.a_T_b", keyframe.motion.a_T_b)
        _check_wheels("keyframe.motion", keyframe.motion)
    if keyframe.world_T_body_guess is not None:
        _check_pose("keyframe.world_T_body_guess", keyframe.world_T_body_guess)
    if keyframe.surfaces is not None:
        as_shape("keyframe.surfaces", keyframe.surfaces, (None, 9))
    if keyframe.viewpoint is not None:
        as_shape("keyframe.viewpoint", keyframe.viewpoint, (3,))
    for number, seen in enumerate(keyframe.observations):
        name = f"keyframe.observations[{number}]"
        if not isinstance(seen, Observation):
            raise ValueError(f"{name}: expected a plane or a line that was seen, got {type(seen).__name__}")
        check_fields(name, seen)
        if isinstance(seen, PlaneObservation):
            check_extent(f"{name}.plane", seen.plane.frame, seen.plane.outline)
            _check_covariance(f"{name}.plane.covariance", seen.plane.covariance, (3,))
        else:
            _check_pose(f"{name}.body_T_sensor", seen.body_T_sensor)
            _check_covariance(f"{name}.line.covariance", seen.line.covariance, (2,))
            _check_near(f"{name}.line.endpoints", seen.line.endpoints, _LARGEST_PLANE_M)
    check_fields("keyframe", keyframe)
    for number, known in enumerate(keyframe.pose_measurements):
        try:
            known.factor(0)
        except ValueError as error:
            raise ValueError(f"keyframe.pose_measurements[{number}]: {error}") from error
    for number, match in enumerate(keyframe.places):
        name = f"keyframe.places[{number}]"
        if not 0 <= match.keyframe < index:
            raise ValueError(f"{name}.keyframe: expected an earlier keyframe, got {match.keyframe}")
        as_shape(f"{name}.delta", match.delta, (6 if match.is_spatial else 3,))
        _check_near(f"{name}.delta", match.delta, _FARTHEST_M)
        _check_covariance(f"{name}.covariance", match.covariance, match.delta.shape)


def without_repetitions(keyframes: Iterable[Keyframe]) -> Iterator[Keyframe]:
    """Keyframes, with a note for a 3D scan that is the one before to the last bit though wheels have moved on.

    The sensor hangs: noise repeats nothing. (2D scans are left out as a log is read, `slam.io.plausibility`. Of a lidar
    whose clouds are unbent no scan is the one before.)
    """
    seen, way = np.empty((0, 9)), np.eye(4)
    for keyframe in keyframes:
        way = way if keyframe.motion is None else way @ keyframe.motion.a_T_b
        surfaces = keyframe.surfaces
        if surfaces is None or not len(surfaces) or not np.array_equal(surfaces, seen):
            seen, way = (seen, way) if surfaces is None else (surfaces, np.eye(4))
        elif keyframe.motion is not None and are_apart(np.eye(4), way, metres=0.05, radians=0.05):
            problem = f"at {keyframe.stamp_ns * 1e-9:.3f} s: the scan before, to the last bit, while the wheels moved"
            keyframe = replace(keyframe, observations=[], surfaces=None, notes=(*keyframe.notes, problem))
        yield keyframe


def check_extent(name: str, frame: FloatArray, outline: BaseGeometry | None) -> None:
    """Refuse a plane that is nowhere, or larger than any: a region is kept in tiles, of which it would need too many.

    Raises:
        ValueError: a frame that is none or lies too far away, or an outline that is too large.
    """
    _check_pose(f"{name}.frame", frame)
    if outline is not None and not outline.is_empty:
        _check_near(f"{name}.outline", np.asarray(outline.bounds), _LARGEST_PLANE_M)


def silences(log: Log, rig: Rig) -> list[str]:
    """One sentence for every sensor of the rig that says nothing, or nothing more."""
    scans = log.scans()
    if not scans:
        return []
    last_ns, sentences = max(scan.stamp_ns for scan in scans), []
    for name in rig.sensors:
        stamps = np.array([scan.stamp_ns for scan in scans if scan.sensor == name], dtype=np.int64)
        if not len(stamps):
            sentences.append(f"sensor {name!r} is silent: no scan of it in the log")
            continue
        period_s = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.0
        limit_s = max(20.0 * period_s, 2.0)  # so many scans, and never so few seconds
        gaps = np.diff(np.append(stamps, last_ns)) * 1e-9
        if gaps.max() > limit_s:
            at = int(np.argmax(gaps))
            ends = "to the end" if at == len(stamps) - 1 else "and then goes on"
            sentences.append(
                f"sensor {name!r} is silent for {gaps[at]:.1f} s from {stamps[at] * 1e-9:.3f} s on {ends}; "
                f"it scans every {period_s:.2g} s"
            )
    return sentences


def blind(keyframes: Sequence[Keyframe]) -> list[str]:
    """The sentence that says so where most keyframes saw nothing: noise stated too small makes every surface rough."""
    without = sum(not frame.observations for frame in keyframes)
    if 2 * without <= len(keyframes):
        return []
    return [
        f"{without} of {len(keyframes)} keyframes saw no plane and no line; where there are some, "
        "the rig states too little noise, or limits of range that leave nothing"
    ]


def skipped(notes: Sequence[str]) -> list[str]:
    """The sentence that counts scans that could not be used, a note each, and says why for the first of them."""
    told = "1 scan could not be used" if len(notes) == 1 else f"{len(notes)} scans could not be used; the first"
    return [f"{told}: {notes[0]}"] if notes else []


def _check_covariance(name: str, covariance: FloatArray, sizes: tuple[int, ...]) -> None:
    check_instance(name, covariance, np.ndarray)
    if covariance.shape not in [(size, size) for size in sizes]:
        wanted = " or ".join(f"({size}, {size})" for size in sizes)
        raise ValueError(f"{name}: expected shape {wanted}, got {covariance.shape}")
    as_shape(name, covariance, covariance.shape)
    if (np.abs(covariance - covariance.T) > 1e-12 + 1e-6 * np.abs(covariance)).any():
        raise ValueError(f"{name}: expected a covariance, got a matrix that is not symmetric")
    least, *_, most = np.linalg.eigvalsh(covariance).tolist()
    if least <= 0.0:
        raise ValueError(f"{name}: expected a positive definite covariance, got the eigenvalue {least:.3g}")
    if least < _LEAST_SIGMA**2 or most > _LARGEST_SIGMA**2:
        extreme = (least if least < _LEAST_SIGMA**2 else most) ** 0.5
        raise ValueError(
            f"{name}: expected standard deviations from {_LEAST_SIGMA:g} to {_LARGEST_SIGMA:g}, got {extreme:.3g}"
        )


def _check_wheels(name: str, motion: Motion) -> None:
    """What a motion says beside its covariance."""
    if motion.response is not None:
        as_shape(f"{name}.response", motion.response, (3, 2))
        if not all(0.0 <= sigma <= _LARGEST_SIGMA for sigma in motion.calibration_sigmas):
            wanted = "standard deviations of scale and curvature"
            raise ValueError(f"{name}.calibration_sigmas: expected {wanted}, got {motion.calibration_sigmas}")
    for sigma in motion.out_of_plane_sigmas if motion.is_planar else ():
        if not _LEAST_SIGMA <= sigma <= _LARGEST_SIGMA:
            wanted = f"standard deviations from {_LEAST_SIGMA:g} to {_LARGEST_SIGMA:g}"
            raise ValueError(f"{name}.out_of_plane_sigmas: expected {wanted}, got {sigma}")


def _check_pose(name: str, pose: FloatArray) -> None:
    as_transform(name, pose)
    _check_near(name, pose[:3, 3], _FARTHEST_M)


def _check_near(name: str, values: FloatArray, most: float) -> None:
    largest = float(np.abs(values).max(initial=0.0))
    if not largest <= most:
        raise ValueError(f"{name}: expected coordinates up to {most:g} m, got {largest:.3g} m")
