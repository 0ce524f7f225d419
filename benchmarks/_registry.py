"""What `python -m benchmarks` runs: the workloads, what they measure, and how long and how short."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Workload:
    """One module of this package."""

    title: str
    says: str  # what is measured, and what the reader must know of it
    full: dict[str, Any] = field(default_factory=dict)  # arguments of its `run`
    short: dict[str, Any] = field(default_factory=lambda: {"short": True})  # the same for `--short`
    gated: bool = False  # its ratios and accuracy are compared with those kept


WORKLOADS: dict[str, Workload] = {
    "fit": Workload(
        "Plane fit with covariance",
        "The other fits give no covariance, except the plain numpy of the same formulas. Angle of the normal and "
        "offset of the plane at the middle of the wall, medians where there are many planes; mean NEES.",
        gated=True,
    ),
    "scenes": Workload(
        "Plane extraction",
        "Whole scenes, ours on one core, Open3D on all, as it does by itself. Open3D's patches need normals, which are "
        "part of the time; `segment_plane` is called again on what is left until a plane has fewer points than asked. "
        "Correct: Hoover's count at 80 % overlap.",
        gated=True,
    ),
    "factors": Workload(
        "Factors",
        "Linearisation and batch solve beside the wheel's own factors. `us each` is the time of one factor; in a "
        "Gauss-Newton step, whose optimiser copies all values at every call of a custom factor, what one line adds.",
        gated=True,
    ),
    "growth": Workload(
        "Growth of the map",
        "Time per keyframe over a long mission, lap after lap of the same rooms, processor time.",
        full={"keyframes": 10_000},
        short={"keyframes": 1000},
        gated=True,
    ),
    "lidar": Workload(
        "A lidar without odometry",
        "Simulated drives of 32 rings of 900 beams: ours from clouds to map and verdict, beside KISS-ICP from the same "
        "clouds to poses, which is told that all of a cloud is of one moment. Root-mean-square error of the positions "
        "from the first one.",
    ),
    "corpus": Workload(
        "Corpus",
        "Drives of many kinds with truth, run as they are. A run counts for its world, its sensors and what is wrong "
        "with it; errors of position over all scans, the first keyframe on its true pose: medians over the runs. NEES "
        "per degree of freedom (1 is right): of the last pose median, mean and the 95 % band of the mean; of the "
        "planes the median of the runs' means and the mean of all planes. "
        "Wrong: the worst error is beyond 10 cm and 3 claimed sigmas; right: the root mean square is within 1 cm or 2 "
        "sigmas; open: so, but the worst is beyond 10 cm; misled: not wrong, though the mount or the prior map it was "
        "given was; how many of each the run itself called doubtful or broken.",
    ),
    "ablation": Workload(
        "Ablation",
        "The corpus with one mechanism at a time switched off: kinds of drive that get worse, and better, beyond the "
        "spread of their runs.",
    ),
}
