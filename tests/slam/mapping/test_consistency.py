"""A run audits itself by its innovations; without odometry by what its planes say beyond finding the pose."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam import Keyframe, PlaneSlam, SlamConfig
from slam.config import CoastingConfig
from slam.frontend.input_checks import blind
from slam.frontend.odometry import Motion
from tests.slam.scenes import drive, overstated, run_of
from tests.slam.short_drives import mapped_beginning


def run(seed: int, *, stated: float = 1.0, robust: bool = True) -> PlaneSlam:
    """Round the room without odometry, the sigmas of the planes stated so many times too small."""
    slam = PlaneSlam(SlamConfig(coasting=CoastingConfig() if robust else CoastingConfig(robust=None)))
    frames = overstated(drive(seed, count=12, turns=0.3).keyframes, stated**2)
    return run_of((replace(frame, motion=None) for frame in frames), slam)


def test_nis_of_an_honest_run_without_odometry_is_in_its_band_with_six_degrees_less():
    slams = [run(seed, robust=False) for seed in range(8)]
    rows = [row for slam in slams for row in slam.audit.history["plane"]]
    dof = sum(dof for _, _, dof in rows)
    assert dof == 8 * 11 * (6 * 3 - 6)
    low, high = chi2_distribution.ppf([0.005, 0.995], dof) / dof
    assert low < sum(chi2 for _, chi2, _ in rows) / dof < high and all(slam.audit.warnings() == [] for slam in slams)


def test_with_the_robust_kernel_it_is_not_called_over_confident_and_with_lies_it_is():
    assert run(0).audit.warnings() == [] and run(0).audit.summary()[0].count > 40
    [warning] = run(0, stated=3.0).audit.warnings()
    assert warning.startswith("the plane factors are over-confident: mean NIS per degree of freedom ")


def test_in_a_bare_room_that_looks_alike_from_both_ends_the_body_does_not_change_ends():
    """By noise alone it did in all of these: the room is its own image, turned by 180 deg about three axes."""
    for seed in (2, 4, 5, 8):
        poses = run(seed).trajectory.poses
        away = np.linalg.norm(poses[:, :3, 3] - drive(seed, count=12, turns=0.3).world_T_body[:, :3, 3], axis=1)
        assert away.max() < 0.1


def test_a_guess_too_wide_to_tell_planes_apart_is_no_odometry():
    wide, (first, *rest) = Motion(np.eye(4), np.eye(6), (1.0, 1.0, 1.0)), drive(1, count=3, turns=0.06).keyframes
    slam = run_of([first, *(replace(frame, motion=wide) for frame in rest)])
    assert sum(dof for _, _, dof in slam.audit.history["plane"]) == 2 * 12


def test_a_run_that_sees_nothing_says_so():
    seen, empty = drive(0, count=1).keyframes, [Keyframe(index, []) for index in range(2)]
    assert blind([*seen, *empty])[0].startswith("2 of 3 keyframes saw no plane and no line")
    assert blind([*seen, *empty[:1]]) == blind([]) == []


def test_long_walls_agree_with_each_other_though_wheels_know_the_heading_badly():
    """A hundredth of a radian is a thousand sigmas of a wall of 20 m: by one linearisation the mean of these is 1.4."""
    runs = [mapped_beginning("bare/level/undescribed", seed)[0].slam for seed in (211003, 211008)]
    audited = [(chi2, dof) for slam in runs for _, chi2, dof in slam.audit.history["line"]]
    matches = [one.match for slam in runs for decided in slam.decisions for one in decided if one.match is not None]
    for rows in (audited, [(match.chi2, match.dof) for match in matches]):
        chi2, dof = np.sum(rows, axis=0)
        low, high = chi2_distribution.ppf((0.005, 0.995), dof) / dof
        assert dof > 200 and low < chi2 / dof < high
