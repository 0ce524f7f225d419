"""A real log of several laps, mapped once: relations hold, nothing is lost, walls are single.

The first 330 of its 910 scans, which take an eighth of the time: the rest drives through what is mapped. All of it is a
drive of `python -m benchmarks corpus`.
"""

import numpy as np
import pytest

from slam import SlamConfig
from slam.evaluation import metres_of_wall
from slam.evaluation.trajectories import absolute_error, read_relations, relation_errors
from slam.io.load import load
from slam.io.trajectories import read_tum
from slam.runs.slam_run import Run, run_slam
from tests.slam.real_data import needs
from tests.slam.runs.test_real_logs import assert_honest
from tests.slam.short_drives import until


@pytest.fixture(scope="module")
def intel() -> Run:
    """The Intel Research Lab, as mapped at first: all of it is doubtful then, and its repair takes as long again."""
    log, rig = load(needs("intel/intel.clf.gz"))
    return run_slam(until(log, log.scans()[329].stamp_ns), rig, SlamConfig(), repair=False)


def test_the_audit_finds_the_covariances_honest(intel):
    assert_honest(intel.slam, 1000)


def test_the_intel_log_keeps_its_relations(intel):
    """Those of its 97 verified relations; a grid particle filter has 0.036 m and 0.56 deg over all of them."""
    errors = relation_errors(intel.trajectory, read_relations(needs("intel/intel.relations.gz")))
    assert errors.translation_m.size == 22 and errors.translation_m.mean() < 0.03
    assert np.rad2deg(errors.rotation_rad).mean() < 0.6 and np.sqrt(np.mean(errors.translation_m**2)) < 0.04


def test_no_part_of_the_intel_log_is_lost(intel):
    """Against the corrected poses of a particle filter, which themselves are 4 cm off the relations."""
    errors = absolute_error(intel.trajectory, read_tum(needs("intel/reference.tum")), alignment="se2")
    assert np.sqrt(np.mean(errors.translation_m**2)) < 0.25 and errors.translation_m.max() < 0.8


def test_few_walls_of_the_intel_log_are_double(intel):
    n_walls, length = metres_of_wall(intel.planes)
    assert length > 150.0 and n_walls / length < 0.6


def test_the_wheels_curvature_is_learnt(intel):
    assert intel.slam.calibration.mean[1] > 0.03  # they turn it to one side, 4 deg per metre
