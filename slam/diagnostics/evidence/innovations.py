"""Evidence: chi2 of matches or of the odometry says that errors are larger than claimed, and that it matters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, ndtr

from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import motion_covariance
from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, at_least, named
from slam.frontend.odometry import planar_delta
from slam.frontend.wheel_calibration import WheelCalibration
from slam.geometry.frames import evenly, inverse
from slam.planeslam import PlaneSlam
from slam.sensors.rig import Rig
from slam.tracking.odometry_scale import scaled
from spplanes._check import FloatArray

#: What a user is promised of a sound map: no error beyond this, m, or so many of the standard deviations it claims.
PROMISED_M, PROMISED_SIGMAS = 0.1, 3.0


def claimed_sigmas(run: PlaneSlam) -> dict[int, float]:
    """Largest standard deviation of the position of some keyframes, evenly over the run, by their index, m."""
    chosen = evenly(len(run.keyframes), 24)
    blocks = {key: run.backend.read_covariance(pose_symbol(key))[3:, 3:] for key in chosen}
    return {key: float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for key, block in blocks.items()}


def nis_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Accepted matches scatter more than their covariances say, and the poses err by as much more.

    The mean NIS is the factor by which the covariances are too small, if it is of all measurements alike; it matters
    where errors larger by its root would break what a sound map promises more often than once in a hundred cases.
    """
    rows = [row for history in run.audit.history.values() for row in history]
    dof = sum(row[2] for row in rows)
    if not dof:
        return
    total = float(sum(row[1] for row in rows))
    scattered = "what was matched scatters {0:.2g} times as much as stated: "
    sentence = scattered + "claimed sigmas up to {1:.2g} m are too small by that"
    yield from too_small(run, "innovations", (total, dof), sentence)


def too_small(
    run: PlaneSlam, kind: str, test: tuple[float, float], sentence: str, *, frames: tuple[int, ...] = (), tests: int = 1
) -> Iterator[Evidence]:
    """Covariances that are too small by chi2 over what is expected of it (`test`), where that breaks the promise.

    The sentence names the factor on sigma and the largest sigma claimed; what it says comes from `frames`, of so many
    `tests`.
    """
    chi2, dof = test
    factor, sigmas = float(np.sqrt(max(chi2 / dof, 1.0))), claimed_sigmas(run)
    risky = [key for key, sigma in sigmas.items() if _risk(factor * sigma, sigma) > SIGNIFICANCE]
    if risky:
        p_value = min(tests * float(chdtrc(dof, chi2)), 1.0)
        told = f"{sentence.format(factor, max(sigmas.values()))} at {named(risky)}"
        every = tuple(sorted({*frames, *risky}))
        yield Evidence(kind, "doubtful", p_value, factor, "times the stated sigma", every, told)


def _risk(sigma_m: float, claimed_m: float) -> float:
    """Probability that an error of standard deviation `sigma_m` breaks the promise where `claimed_m` is claimed."""
    return 2.0 * float(ndtr(-max(PROMISED_M, PROMISED_SIGMAS * claimed_m) / max(sigma_m, 1e-12)))


def odometry_evidence(run: PlaneSlam, rig: Rig) -> Iterator[Evidence]:
    """Steps of the odometry against the same steps of the estimate, and what it means for the poses.

    The estimate has used the odometry, so a residual r of a step of covariance S, whose estimate has P, has S - P where
    S is honest: the sum of r^T S^-1 r is expected to be that of 3 - tr(S^-1 P), and chi2 with as many degrees of
    freedom is wider than it. The root of their ratio is by how much the odometry errs more than it says, and at most
    the poses. The sum of all residuals is asked the same: errors of calibration, however small in a step, add up where
    those of a random walk do not. What was found of these is taken out; but where nobody stated them, windows of a
    push-broom laser alone were measured with them.
    """
    scales = {step.keyframe: step.scale for step in run.odometry_record.steps}
    alone = {sensor.kind for sensor in rig.sensors.values()} == {"slice"}
    in_windows = alone and not any(rig.odometry.calibration_sigmas)
    calibration = WheelCalibration() if in_windows else run.calibration
    steps = {keyframe: _residual(run, keyframe, calibration, scales.get(keyframe, 1.0)) for keyframe in _steps(run)}
    if not steps:
        return
    tested = {keyframe: _test(residual) for keyframe, residual in steps.items()}
    frames = tuple(keyframe for keyframe, (chi2, _) in tested.items() if chi2 > chdtri(3, 0.05))
    one_by_one = sum(chi2 for chi2, _ in tested.values()), sum(dof for _, dof in tested.values())
    added_up = _test(_Residual(*(np.sum(terms, axis=0) for terms in zip(*steps.values(), strict=True))))
    for test, of, sentence in (
        (one_by_one, frames, "the odometry errs {0:.2g} times as much as stated, most at "),
        (added_up, tuple(steps), "errors of the odometry add up to {0:.2g} times what is stated, "),
    ):
        if test[1] >= 1.0 and of:
            sentence += named(of) + ": claimed sigmas up to {1:.2g} m rest on it"
            yield from too_small(run, "odometry", test, sentence, frames=of, tests=2)


def believed_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Steps of odometry that was found wrong elsewhere, used as stated where no scan would have told such errors.

    They are as far off as those found, as often as those were, and all the same way at worst. It matters where that is
    more than a sound map promises.
    """
    record = run.odometry_record
    wrong = [step.keyframe for step in record.steps if step.check.against]
    believed = record.believed()
    if not wrong or not believed:
        return
    share = len(wrong) / len(record.steps)
    off = share * sum(float(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))) for _, errors in believed)
    if off <= max(PROMISED_M, PROMISED_SIGMAS * max(claimed_sigmas(run).values())):
        return
    frames = tuple(keyframe for keyframe, _ in believed)
    p_value = float(at_least(len(wrong), len(record.steps), record.significance))
    sentence = (
        f"what was seen speaks against the odometry at {named(wrong)}, and could not have at {named(frames)}, which "
        f"rest on it: they may be {off:.2g} m off"
    )
    yield Evidence("believed odometry", "doubtful", p_value, off, "m", frames, sentence)


def _steps(run: PlaneSlam) -> list[int]:
    """Keyframes to which planar odometry leads between two that the graph still holds, some 60 evenly over the run.

    Not those where it was not taken as stated: nothing rests there on what it states. Where that is half of all that
    scans were held against, it is not the wheels alone that may be wrong, and all count.
    """
    checked = run.odometry_record.steps
    unused = {step.keyframe for step in checked if step.used != "as stated"}
    if 2 * len(unused) >= len(checked):
        unused = set()
    held = [run.backend.holds(pose_symbol(k)) for k in range(len(run.keyframes))]
    motions = (frame.motion for frame in run.keyframes)
    known = [
        k
        for k, motion in enumerate(motions)
        if k and k not in unused and motion is not None and motion.is_planar and all(held[k - 1 : k + 1])
    ]
    return known[:: max(1, -(-len(known) // 60))]


class _Residual(NamedTuple):
    """What the odometry says of a step less what the estimate does."""

    off: FloatArray
    """(x, y, theta), shape (3,), x and y along the axes of the start."""
    stated: FloatArray
    """Covariance of the odometry, shape (3, 3)."""
    known: FloatArray
    """Covariance of the estimate, shape (3, 3)."""


def _residual(run: PlaneSlam, keyframe: int, calibration: WheelCalibration, scale: float) -> _Residual:
    """Of a step taken to err by so many times what is stated."""
    keys, measured = [pose_symbol(keyframe - 1), pose_symbol(keyframe)], run.keyframes[keyframe].motion
    assert measured is not None  # `_steps`
    motion = scaled(calibration.corrected(measured), scale)
    a_T_b = inverse(run.backend.pose(keys[0])) @ run.backend.pose(keys[1])
    off = planar_delta(inverse(motion.a_T_b) @ a_T_b)
    off[:2] = motion.a_T_b[:2, :2] @ off[:2]
    known = motion_covariance(a_T_b, run.backend.read_joint_covariance(keys, shared=False).of(keys))
    return _Residual(off, motion.covariance, known)


def _test(residual: _Residual) -> tuple[float, float]:
    """Chi2, and what it is expected to be."""
    by_stated = np.linalg.solve(residual.stated, np.column_stack((residual.off, residual.known)))
    return float(residual.off @ by_stated[:, 0]), max(3.0 - float(np.trace(by_stated[:, 1:])), 0.0)
