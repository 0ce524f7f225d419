"""A real log of four laps, mapped once: relations hold, nothing is lost, walls are single."""

from __future__ import annotations

import numpy as np
import pytest

from slam.evaluation.map_summary import metres_of_wall
from slam.evaluation.relations import read_relations, relation_errors
from slam.evaluation.trajectories import absolute_error
from slam.io.trajectories import read_tum
from slam.runs.slam_run import Run
from tests.slam.real_data import needs
from tests.slam.runs.test_real_logs import assert_honest, mapped


@pytest.fixture(scope="module")
def intel() -> Run:
    """Four laps of the Intel Research Lab, as mapped at first: that is doubtful, and its repair takes as long again."""
    return mapped("intel/intel.clf.gz", repair=False)


def test_the_audit_finds_the_covariances_honest(intel):
    assert_honest(intel.slam, 2000)


def test_the_intel_log_keeps_its_relations(intel):
    """All 97 verified relations; a grid particle filter has 0.036 m and 0.56 deg, raw odometry 3.2 m and 17 deg."""
    errors = relation_errors(intel.trajectory, read_relations(needs("intel/intel.relations.gz")))
    assert errors.translation_m.size == 97
    assert errors.translation_m.mean() < 0.05
    assert np.rad2deg(errors.rotation_rad).mean() < 0.9
    assert np.sqrt(np.mean(errors.translation_m**2)) < 0.08


def test_no_part_of_the_intel_log_is_lost(intel):
    """Against the corrected poses of a particle filter, which themselves are 4 cm off the relations."""
    errors = absolute_error(intel.trajectory, read_tum(needs("intel/reference.tum")), alignment="se2")
    assert np.sqrt(np.mean(errors.translation_m**2)) < 0.25
    assert errors.translation_m.max() < 0.8


def test_few_walls_of_the_intel_log_are_double(intel):
    n_walls, length = metres_of_wall(intel.planes)
    assert length > 150.0
    assert n_walls / length < 0.6


def test_the_wheels_curvature_is_learnt(intel):
    assert intel.slam.calibration.mean[1] > 0.03  # they turn it to one side, 4 deg per metre


def test_every_stage_has_its_time(intel):
    stages = {
        "measure",
        "predict",
        "associate",
        "optimise",
        "marginals",
        "same plane",
        "loops",
        "map",
    }
    assert stages <= set(intel.clock.seconds)
