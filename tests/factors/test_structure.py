"""What is known about planes: zero error where it holds, and the size of the error where it does not."""

import gtsam
import numpy as np
import pytest

from factors import direction_prior, distance_factor, parallel_factor, perpendicular_factor, upright_prior
from tests.factors.factor_scenes import TIED_NORMALS, frame_of, random_normals, random_pose, values_of

LA, LB = gtsam.symbol("l", 1), gtsam.symbol("l", 2)
AA, AB = gtsam.symbol("a", 1), gtsam.symbol("a", 2)
ANCHORS = [(None, None), (AA, None), (None, AB), (AA, AB), (AA, AA)]


def test_native_and_custom_direction_agree():
    for seed in range(50):
        rng = np.random.default_rng(seed)
        towards, landmark = rng.normal(size=3), gtsam.OrientedPlane3(np.array([*random_normals(rng, 1)[0], 1.0]))
        values = values_of(l1=landmark, a1=gtsam.Pose3())
        native = direction_prior(LA, towards, 0.1).whitenedError(values)
        custom = direction_prior(LA, towards, 0.1, anchor_key=AA).whitenedError(values)
        np.testing.assert_allclose(native, custom, atol=1e-12)


def anchored(normal, d, world_T_anchor):
    """Landmark of a world plane n.x = d in an anchor's frame."""
    return gtsam.OrientedPlane3(np.array([*normal, -d])).transform(world_T_anchor)


@pytest.mark.parametrize(("anchor_a", "anchor_b"), ANCHORS)
@pytest.mark.parametrize("facing", [1.0, -1.0])
def test_a_room_satisfies_what_is_known_of_it(anchor_a, anchor_b, facing):
    """Floor z = 0 and a plane 2.5 m above it that faces up or down; every error is the stated deviation."""
    rng = np.random.default_rng(3)
    poses = {AA: random_pose(rng), AB: random_pose(rng)}
    floor = anchored([0.0, 0.0, 1.0], 0.0, poses.get(anchor_a, gtsam.Pose3()))
    ceiling = anchored([0.0, 0.0, facing], facing * 2.5, poses.get(anchor_b, gtsam.Pose3()))
    values = values_of(l1=floor, l2=ceiling, a1=poses[AA], a2=poses[AB])
    where = {"anchor_a": anchor_a, "anchor_b": anchor_b}
    assert parallel_factor(LA, LB, 0.1, **where).error(values) < 1e-20
    assert distance_factor(LA, LB, 2.5, 0.1, **where).error(values) < 1e-20
    assert distance_factor(LA, LB, 2.4, 0.1, **where).error(values) == pytest.approx(0.5)
    assert perpendicular_factor(LA, LB, 0.1, **where).error(values) == pytest.approx(50.0)


def test_distance_is_measured_where_it_is_said():
    """Two planes 0.1 rad apart, 2 m at the origin: at (10, 0, 0) the second plane is 2 + 10 tan 0.1 above the first."""
    values = values_of(l1=anchored([0.0, 0.0, 1.0], 0.0, gtsam.Pose3()))
    tilt = np.array([-np.sin(0.1), 0.0, np.cos(0.1)])
    values.insert(LB, anchored(tilt, 2.0 * np.cos(0.1), gtsam.Pose3()))
    here = distance_factor(LA, LB, 0.0, 1.0).unwhitenedError(values)
    there = distance_factor(LA, LB, 0.0, 1.0, at=(10.0, 0.0, 5.0)).unwhitenedError(values)
    np.testing.assert_allclose(here, 2.0 * np.cos(0.1))
    np.testing.assert_allclose(there, (2.0 + 10.0 * np.tan(0.1)) * np.cos(0.1))


def test_size_of_the_angle_errors():
    """A normal 0.01 rad off costs (0.01 / sigma)^2 / 2, in any direction and whatever side it faces."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        normal = TIED_NORMALS[seed % len(TIED_NORMALS)]
        frame = frame_of(normal, np.zeros(3), rng.uniform(0, 6.0))
        off = (np.cos(0.01) * normal + np.sin(0.01) * frame[:3, 0]) * (-1.0) ** seed
        values = values_of(l1=anchored(normal, 1.0, gtsam.Pose3()), l2=anchored(off, 2.0, gtsam.Pose3()))
        expected = 0.5 * (np.sin(0.01) / 0.02) ** 2
        assert parallel_factor(LA, LB, 0.02).error(values) == pytest.approx(expected, rel=1e-6)
        assert direction_prior(LB, normal, 0.02).error(values) == pytest.approx(expected, rel=1e-6)
        assert upright_prior(LB, 0.02, up=frame[:3, 0]).error(values) == pytest.approx(expected, rel=1e-6)
        assert upright_prior(LB, 0.02, up=frame[:3, 1]).error(values) < 1e-12
