"""The paper's mapping: a vertical laser pushed through a corridor, poses given with their uncertainty, planes out.

Scan after scan goes into a `PlaneMapper`: strips of two scans are filtered, segmented, and join the planes that are
already there. The localisation's error is common to all points of a scan, and told as such; it is in every plane's
covariance. The truth is known here, so that the claim can be checked.
"""

import numpy as np

from slam import SlamConfig
from slam.evaluation import facing_pairs, match_planes
from slam.runs.mapping_run import run_map
from slam.simulation import simulate_mission


def main() -> None:
    """Simulate, map, compare."""
    mission = simulate_mission("corridor", n_scans=120, seed=0)
    result = run_map(mission.log, mission.rig, SlamConfig())
    share = 100.0 * result.n_points_represented / result.n_points_seen
    print(
        f"{len(result.trajectory)} scans, {result.n_points_seen} points, {len(result.planes)} planes hold {share:.1f} %"
    )

    large = [plane for plane in result.planes if plane.plane.n_points > 1000]
    print("\nplane  points   distance error   predicted sigma")
    for match in match_planes([plane.plane for plane in large], mission.truth.planes):
        plane = large[match.estimated]
        sigma = np.sqrt(plane.plane.covariance[0, 0])
        print(f"p{plane.id:<4} {plane.plane.n_points:8} {1e3 * match.distance_m:+12.2f} mm {1e3 * sigma:14.2f} mm")

    height = next(pair for pair in facing_pairs(result.planes) if pair.name == "height")
    print(f"\nheight of the corridor {height.distance_m:.4f} +- {height.sigma_m:.4f} m, truly 2.7000 m")


if __name__ == "__main__":
    main()
