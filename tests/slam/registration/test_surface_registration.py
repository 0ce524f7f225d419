"""Scans laid on what was seen before by all their returns: where planes leave a direction open, edges hold it."""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.stats import chi2

from slam.frontend.scan_surfaces import ON_EDGE, ON_NO_PLANE, ON_PLANE
from slam.geometry.frames import inverse
from slam.registration.surface_registration import LocalMap, _Residuals, align, moved
from tests.slam.depth_scenes import between, looking, measured

FIRST = looking(-1.5, 0.0, 1.2, 0.0, 0.6)
#: 10 cm to the side, along the one direction that floor, top and side leave open, and turned by 3 deg.
SECOND = looking(-1.5, 0.1, 1.22, 0.05, 0.62)


def off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Logmap(gtsam.Pose3(inverse(found) @ true))


def test_edges_hold_the_direction_that_the_planes_leave_open() -> None:
    rng = np.random.default_rng(0)
    known, seen = measured(FIRST, rng).surfaces, measured(SECOND, rng).surfaces
    assert known is not None and seen is not None
    found = align(seen, LocalMap([(np.eye(4), known)]), [np.eye(4)])
    assert np.linalg.norm(off(found.known_T_seen, between(FIRST, SECOND))[3:]) < 0.01
    planes = [one[one[:, 7] == ON_PLANE] for one in (known, seen)]
    bare = align(planes[1], LocalMap([(np.eye(4), planes[0])]), [np.eye(4)])
    along = SECOND[:3, :3].T @ np.array([0.0, 1.0, 0.0])
    by_all, by_planes = (
        np.sqrt(along @ np.linalg.inv(one.information + 1e-6 * np.eye(6))[3:, 3:] @ along) for one in (found, bare)
    )
    assert by_all < 0.02
    assert by_planes > 10.0 * by_all


def test_a_wrong_place_scores_less_than_the_right_one() -> None:
    rng = np.random.default_rng(1)
    known, seen = measured(FIRST, rng).surfaces, measured(SECOND, rng).surfaces
    assert known is not None and seen is not None
    wrong = between(FIRST, SECOND)
    wrong[:3, 3] += FIRST[:3, :3].T @ np.array([0.0, 0.5, 0.0])
    there = LocalMap([(np.eye(4), known)])
    assert align(seen, there, [between(FIRST, SECOND)]).score > align(seen, there, [wrong]).score + 0.05


def elements(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """True elements of three surfaces and clutter, and the same as measured."""
    points = rng.uniform((2.0, -2.0, -2.0), (6.0, 2.0, 2.0), (900, 3))
    normals = np.eye(3)[rng.integers(0, 3, 900)]
    kinds = rng.choice([ON_PLANE, ON_NO_PLANE, ON_EDGE], 900, p=[0.6, 0.3, 0.1])
    true = np.column_stack((points, normals, np.full(900, 1e-9), kinds.astype(float)))
    seen = true.copy()
    seen[:, :3] += normals * (sigma * rng.standard_normal(900))[:, None]
    seen[:, 6] = sigma
    return true, seen


def test_the_stated_covariance_is_what_the_error_has() -> None:
    rng, nees, beyond = np.random.default_rng(2), [], []
    for _ in range(60):
        true, seen = elements(rng, 0.005)
        motion = gtsam.Pose3.Expmap(rng.normal(0.0, (0.01, 0.01, 0.01, 0.02, 0.02, 0.02))).matrix()
        found = align(moved(seen, inverse(motion)), LocalMap([(np.eye(4), true)]), [np.eye(4)])
        error = off(found.known_T_seen, motion)
        nees.append(error @ found.information @ error)
        information, told = found.off_planes
        rest = np.linalg.solve(information, told) - error
        beyond.append(rest @ information @ rest)
    high = chi2.ppf(0.9995, 6 * 60) / 60
    assert 0.6 * 6 < np.mean(nees) < high  # the kernel takes a fifth of the information of what is good
    assert 0.6 * 6 < np.mean(beyond) < high


def test_residuals_have_the_derivative_that_they_say() -> None:
    true, seen = elements(np.random.default_rng(3), 0.005)
    known, motion = LocalMap([(np.eye(4), true)]), gtsam.Pose3.Expmap(np.full(6, 0.003)).matrix()
    reach = np.full(len(seen), 0.3)
    here = _Residuals.of(seen, known, motion, reach)
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        there = _Residuals.of(seen, known, motion @ gtsam.Pose3.Expmap(step).matrix(), reach)
        np.testing.assert_array_equal(there.index, here.index)
        np.testing.assert_allclose((there.off - here.off) / 1e-6, here.jacobian[:, k], atol=1e-4)
