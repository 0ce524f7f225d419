"""Evidence of the odometry (residuals of its steps, one by one and added up) and of mounts that made it look wrong."""

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam import Keyframe, SlamConfig
from slam.diagnostics.evidence.innovations import _Residual, _test, claimed_sigmas
from slam.diagnostics.evidence.mounts import heading_evidence
from slam.frontend.odometry import Motion
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Mount, Rig, Sensor
from tests.slam.short_drives import mapped_beginning

#: Covariances of a step (x, y, theta) as the odometry states it, and of the estimate: the third axis is told.
STATED = np.array([[4e-4, 1e-5, 0.0], [1e-5, 1e-4, 2e-5], [0.0, 2e-5, 5e-5]])
KNOWN = np.array([[3e-4, 0.0, 0.0], [0.0, 5e-5, 0.0], [0.0, 0.0, 1e-6]])


def summed(errors: np.ndarray) -> tuple[float, float]:
    """Chi2 of steps (N, 3) added up, and what is expected."""
    return _test(_Residual(errors.sum(axis=0), len(errors) * STATED, len(errors) * KNOWN))


def test_the_sum_of_honest_residuals_has_the_chi2_it_is_expected_to_have():
    rng = np.random.default_rng(8)
    sums = [summed(rng.multivariate_normal(np.zeros(3), STATED - KNOWN, 30)) for _ in range(2000)]
    ratios = [chi2 / dof for chi2, dof in sums]
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.std(ratios) / np.sqrt(len(ratios)))


def test_a_bias_that_no_step_shows_adds_up():
    errors = np.random.default_rng(9).multivariate_normal(np.zeros(3), STATED - KNOWN, 60)
    errors[:, 2] += np.sqrt(STATED[2, 2])
    alone = np.array([_test(_Residual(one, STATED, KNOWN)) for one in errors])
    assert alone[:, 0].sum() < 2.5 * alone[:, 1].sum()
    chi2, dof = summed(errors)
    assert chi2 > 20.0 * dof


@pytest.mark.parametrize("wheels, least_m, most_m", [("biased", 0.4, 1.5), ("good", 0.0, 0.15)])
def test_an_error_of_calibration_that_a_corridor_does_not_tell_is_claimed(wheels: str, least_m: float, most_m: float):
    """Ways 3 % wrong, 0.6 m along a bare corridor: the walls tell that the heading drifts, nothing how long it is."""
    run, off = mapped_beginning(f"bare/lidar16/{wheels}", 640003, 40)
    claimed = max(claimed_sigmas(run.slam).values())
    assert run.verdict.verdict == "sound" and least_m < claimed < most_m
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 3.0 * claimed


def test_windows_measured_by_wheels_with_an_error_of_calibration_are_doubted():
    """It is taken out of the steps, but not out of what a push-broom laser saw along them."""
    run, _ = mapped_beginning("bare/pushbroom/biased", 710006, 600)
    assert run.slam.calibration.mean.any() and "errors of the odometry add up to" in run.verdict.line


@pytest.mark.parametrize("name, seed", [("office/level/good", 94001), ("glass/level/biased", 94003)])
def test_a_laser_mounted_backwards_is_named_though_its_scans_fit_each_other(name: str, seed: int) -> None:
    drive = make_drive(Recipe.parse(f"{name}/backwards"), seed)
    verdict = run_slam(drive.log, drive.rig, SlamConfig()).verdict
    assert verdict.verdict == "broken" and any("mounted backwards" in reason for reason in verdict.reasons)


def along(steps: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) of a body that goes so far along its x at every step."""
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps)
    return poses


def frames(count: int, motion: Motion | None = None) -> list[Keyframe]:
    return [Keyframe(k, [], motion if k else None) for k in range(count)]


def test_a_body_that_goes_backwards_all_along_is_doubted_where_nobody_measured_it() -> None:
    lidar = Sensor(kind="cloud", body_T_sensor=Mount(xyz_m=(0.1, 0.0, 0.5)), range_sigma_m=0.01, range_max_m=30.0)
    rig, unknown = (Rig(sensors={"lidar": one}) for one in (lidar, lidar.model_copy(update={"mount": Mount()})))
    back, ahead = along(np.full(30, -0.4)), along(np.full(30, 0.4))
    [found] = heading_evidence(frames(31), back, rig)
    assert found.grade == "doubtful" and found.p_value < 1e-6 and "mounted backwards" in found.sentence
    assert found.size == pytest.approx(1.0) and found.keyframes == tuple(range(1, 31))
    there_and_back = along(np.concatenate((np.full(15, 0.4), np.full(15, -0.4))))
    measured, sideways = Motion(np.eye(4), np.eye(3), (0.1, 0.1, 0.1)), back.copy()
    sideways[:, 1, 3] = 5.0 * sideways[:, 0, 3]
    for poses in (ahead, there_and_back, sideways, back[:5], back[:1]):
        assert not list(heading_evidence(frames(len(poses)), poses, rig))
    assert not list(heading_evidence(frames(31, measured), back, rig))
    assert not list(heading_evidence(frames(31), back, unknown))
