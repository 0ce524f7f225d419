"""Joining missions: how many pairs of different buildings are joined, and how many of one building are not.

`python -m benchmarks joins --buildings 46` compares all 1,035 pairs of 46 simulated buildings, then two visits of each,
half overlapping and driven the opposite ways.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np

from benchmarks.corpus.drives import Recipe, make_drive
from slam import SlamConfig
from slam.geometry.frames import inverse
from slam.joining import FinishedMission, Mission
from slam.joining.overlap import compare_missions
from slam.runs.slam_run import run_slam

#: In the plane: heading, x, y of GTSAM's tangent.
_PLANAR = [2, 3, 4]


def mission_of(
    recipe: Recipe, seed: int, *, visit: int = 0, part: tuple[float, float] = (0.0, 1.0), backwards: bool = False
) -> tuple[Mission, np.ndarray]:
    """A simulated mission, and where its frame is in the building's, (4, 4)."""
    drive = make_drive(recipe, seed, visit=visit, part=part, backwards=backwards)
    run = run_slam(drive.log, drive.rig, SlamConfig())
    mission = FinishedMission.of(f"{recipe.name} {seed} {visit}", run.slam, drive.rig).mission
    return mission, drive.truth.poses_at(mission.trajectory.stamps_ns[:1])[0]


def true_joins(recipe: Recipe, seeds: Sequence[int], significance: float) -> tuple[Counter[str], list[float]]:
    """Verdicts on two visits of each building, and the NEES (3 dof) of the motions of those that are joined."""
    verdicts, nees = Counter[str](), []
    for seed in seeds:
        a, building_T_a = mission_of(recipe, seed, part=(0.0, 0.7))
        b, building_T_b = mission_of(recipe, seed, visit=1, part=(0.3, 1.0), backwards=True)
        found = compare_missions(a, b, SlamConfig(), significance=significance)
        verdicts[found.verdict] += 1
        if found.verdict == "joined" and found.alignment is not None:
            truth = inverse(building_T_a) @ building_T_b
            error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ found.alignment.a_T_b))[_PLANAR]
            spread = found.alignment.covariance[np.ix_(_PLANAR, _PLANAR)]
            nees.append(float(error @ np.linalg.solve(spread, error)))
    return verdicts, nees


def main(arguments: Sequence[str] | None = None) -> int:
    one = argparse.ArgumentParser(prog="python -m benchmarks joins", description=(__doc__ or "").splitlines()[0])
    one.add_argument("--recipe", default="office/level", help="world/sensors, as in benchmarks.corpus.drives")
    one.add_argument("--buildings", type=int, default=46)
    one.add_argument("--visits", type=int, default=20, help="buildings that are visited twice")
    one.add_argument("--significance", type=float, default=1e-3, help="of one pair")
    given = one.parse_args(arguments)
    recipe = Recipe.parse(given.recipe)
    verdicts, nees = true_joins(recipe, range(given.visits), given.significance)
    print(f"two visits of {given.visits} buildings: {dict(verdicts)}; mean NEES {np.mean(nees):.2f} of 3", flush=True)
    pairs = combinations([mission_of(recipe, seed)[0] for seed in range(given.buildings)], 2)
    found = (compare_missions(*pair, SlamConfig(), significance=given.significance) for pair in pairs)
    told = Counter(one.verdict for one in found)
    print(f"{sum(told.values())} pairs of {given.buildings} different buildings: {dict(told)}", flush=True)
    return 0
