"""Three missions through one building, none of which knows where the others began, become one map.

Each robot sees half of the building and believes to start at the origin. `slam.joining.join` finds where they overlap
by the constellations of their walls, decides which planes are one, and solves all factors of all missions together:
trajectories in one frame, planes with the covariance that all robots give them.
"""

import numpy as np

from benchmarks.corpus.drives import Recipe, make_drive
from slam import SlamConfig
from slam.geometry.frames import inverse
from slam.joining import FinishedMission, join
from slam.runs.slam_run import run_slam

#: Which part of the building each drives through, and whether from the end.
VISITS = ((0.0, 0.5, False), (0.25, 0.75, True), (0.5, 1.0, False))


def main() -> None:
    """Map each alone, join them, compare with the truth."""
    missions, building_T_mission = [], []
    for number, (start, end, backwards) in enumerate(VISITS):
        recipe = Recipe.parse("office/level")
        drive = make_drive(recipe, seed=0, visit=number, part=(start, end), backwards=backwards)
        run = run_slam(drive.log, drive.rig, SlamConfig())
        missions.append(FinishedMission.of(f"robot {number}", run.slam, drive.rig))
        building_T_mission.append(drive.truth.poses_at(run.trajectory.stamps_ns[:1])[0])
        print(f"robot {number}: {len(run.trajectory)} keyframes, {len(run.planes)} planes")

    joined = join(missions)
    print("\npairs")
    for pair in joined.comparisons:
        print(f"  {pair.first} and {pair.second}: {pair.verdict}, {pair.reason}")

    component = joined.components[0]
    shared = sum(len(places) > 1 for places in component.classes)
    print(f"\none map: {len(component.planes)} planes, {shared} of them seen by several robots")
    print("\nframe of    off by   predicted sigma")
    for number, (name, pose) in enumerate(component.common_T_mission.items()):
        truth = inverse(building_T_mission[0]) @ building_T_mission[number]
        off_mm = 1e3 * float(np.linalg.norm(pose[:2, 3] - truth[:2, 3]))
        sigma_mm = 1e3 * float(np.sqrt(np.trace(component.pose_covariance(number, 0)[3:5, 3:5])))
        print(f"{name}  {off_mm:6.1f} mm {sigma_mm:14.1f} mm")


if __name__ == "__main__":
    main()
