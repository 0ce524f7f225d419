"""The order of the tests, how often what is random is repeated, and what processes have that tests start."""

import os
import sys
from collections.abc import Callable

import pytest

# As `make test` has it, before anything imports numpy: cores have a test each, and threads of BLAS that wait for one
# another on small matrices take up to twenty times as long. Processes that tests start and xdist's have it from here.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Beside the compiled kernels, even where the environment (an image, say) has it turned off: a process that finds no
# bytecode compiles all it imports, and tests start more than a hundred.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

_SOAK = "--soak"
#: Files that take longest, longest first (`pytest --durations` tells): begun last, one would keep a single core busy.
_LONGEST = (
    "tests/slam/runs/test_intel.py",
    "tests/slam/fleet/test_fleet.py",
    "tests/slam/tracking/test_calibration_by_graph.py",
    "tests/slam/session/test_resume.py",
    "tests/test_wheel.py",
    "tests/slam/runs/test_cloud_registration.py",
    "tests/slam/tracking/test_odometry_check.py",
    "tests/slam/runs/test_jobs.py",
    "tests/slam/runs/test_repair.py",
    "tests/slam/registration/test_scans_alone.py",
    "tests/slam/frontend/test_laser_odometry.py",
    "tests/spplanes/fitting/test_robust.py",
    "tests/slam/cli/test_joining.py",
    "tests/slam/cli/test_commands.py",
    "tests/slam/cli/test_verdict.py",
    "tests/test_examples.py",
    "tests/slam/runs/test_missions.py",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(_SOAK, action="store_true", help="only what is repeated at random, often (`make soak`)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest files first, the others in their order; of a soak what asks how often."""
    if config.getoption(_SOAK):
        items[:] = [item for item in items if "times" in getattr(item, "fixturenames", ())]
    place = {name: number for number, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(item.nodeid.split("::", 1)[0], len(place)))


@pytest.fixture
def times(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """How often something random is done: a few times, or as many as `make soak` does it."""

    def choose(few: int, many: int) -> int:
        return many if request.config.getoption(_SOAK) else few

    return choose
