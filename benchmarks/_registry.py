"""What `python -m benchmarks` runs: the workloads, what they measure, and how long and how short."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Workload:
    """One module of this package."""

    title: str
    """Heading of its table."""
    says: str
    """What is measured, and what the reader must know of it."""
    full: dict[str, Any] = field(default_factory=dict)
    """Arguments of its `run`."""
    short: dict[str, Any] = field(default_factory=dict)
    """The same for `--short`."""
    gated: bool = False
    """Its ratios are in the baseline."""
    on_request: bool = False
    """Only run when named."""


_QUICK = {"short": True}
WORKLOADS: dict[str, Workload] = {
    "fit": Workload(
        "Plane fit with covariance",
        "The other fits give no covariance, except the plain numpy of the same formulas. Angle of the normal and "
        "offset of the plane at the middle of the wall, medians where there are many planes; mean NEES.",
        short=_QUICK,
        gated=True,
    ),
    "scenes": Workload(
        "Plane extraction",
        "Whole scenes, ours on one core, Open3D on all, as it does by itself. Open3D's patches need normals, which "
        "are part of the time; `segment_plane` is "
        "called again on what is left until a plane has fewer points than asked. Correct: Hoover's "
        "count at 80 % overlap.",
        short=_QUICK,
        gated=True,
    ),
    "tables": Workload(
        "The paper's tables",
        "Tables II and III on the simulated corridor, each row beside the paper's: its printed time is that of a "
        "Pentium 4 at 1.7 GHz, so no ratio is made of it. From registered scans to planes; purity, true planes found "
        "(of those with more than 200 points) and those split are from truth, of which the paper had none. Table III: "
        "medians of the errors of ceiling height, corridor width, the ceiling's normal and the lockers'; poses share "
        "an error.",
        short=_QUICK,
        gated=True,
    ),
    "steady": Workload(
        "Extraction, steady state",
        "`PlaneMapper.add_scan` on a way of 10,000 scans, up and down a corridor. Memory is what the process grew by.",
        gated=True,
    ),
    "factors": Workload(
        "Factors",
        "Linearisation and batch solve beside the wheel's own factors. `us each` is the time of one factor; in a "
        "Gauss-Newton step, whose optimiser copies all values at every call of a custom factor, what one line adds.",
        short=_QUICK,
        gated=True,
    ),
    "views": Workload(
        "Many views of planes",
        "Poses and planes from points: the samples of ef_bench (10 poses, 5 planes), and 100 poses that all see 30 "
        "planes at 50 points each. Root-mean-square position error over the poses, its median over the samples and its "
        "worst; time of everything from points to poses, mrob's and ours, per graph.",
        short=_QUICK,
        gated=True,
    ),
    "growth": Workload(
        "Growth of the map",
        "Time per keyframe over a long mission, lap after lap of the same rooms, processor time.",
        full={"keyframes": 10_000},
        short={"keyframes": 1000},
        gated=True,
    ),
    "keyframe": Workload(
        "A keyframe of 75,000 points",
        "From the scan to the graph, processor time of every stage, medians over the keyframes once the map has its "
        "planes. Arranging and segmenting are parts of measuring, measured by themselves; associating, updating and "
        "iSAM2 are parts of estimating. In the simulated hall the last position and the planes are held against the "
        "truth.",
        short=_QUICK,
    ),
    "lines": Workload(
        "Line extraction",
        "Scans of random rooms and corridors with truth, and of real logs, beside a textbook split (iterative end "
        "points, three sigma), which has no covariance and no statistics. A wall is found when one true line holds 70 "
        "% of its beams; a line is false when under 80 % of its beams are on one wall, when its chi2 to that wall "
        "exceeds 27.6, or when a better line is on the same wall; the textbook's pieces are judged by their beams "
        "alone. `us each` is the time of one scan; memory is that for all scans and their lines.",
        short=_QUICK,
        gated=True,
    ),
    "end_to_end": Workload(
        "End to end",
        "From log to map, wall time by stage. The real-time factor is the log's own time over that of processing it. "
        "Memory is the largest resident size of a process that does this alone, its libraries included (the first row "
        "is what they take). The yardstick is a fixed piece of numpy and Python in the same process.",
        short=_QUICK,
        gated=True,
    ),
    "startup": Workload(
        "Start-up",
        "Fresh interpreters, files in the cache of the system, taken in turn; medians, the fastest in brackets.",
        short=_QUICK,
        gated=True,
    ),
    "wheel": Workload(
        "The first call",
        "A clean environment, nothing compiled in it, with a wheel that brings its kernels (`make wheel`) and with "
        "one that does not, in turn.",
        on_request=True,
    ),
    "jobs": Workload(
        "Processes that measure",
        "The push-broom office with keyframes measured by one process, and by two ahead of the estimate, in turn; the "
        "fastest of each, since other work on the machine only adds.",
        short=_QUICK,
    ),
    "limits": Workload(
        "What the hardware allows",
        "The slowest stages beside bare loops of the same arithmetic, written by hand in one go over the data "
        "(`benchmarks/_bare.py`), beside reading the data as often as these do at the bandwidth of a bare copy, and "
        "beside GTSAM alone with the same factors. A bare loop is told what a stage has to find out. Fits: the check "
        "that every covariance is one, the start by traces, and two steps, or the sums of the covariance. Segmenting "
        "and measuring: the check of every point, two chi2 tests against neighbours, its share in the sums of a cell, "
        "its distance to two planes, its cell in an outline, and a fit of all points; not in it are the search for "
        "which cells are one plane, and that borders, refining and outlines visit a point several times each: that is "
        "what remains. Lines: sums and chi2 of every split of a scan from both ends, twice, and four steps of a fit; "
        "a real scan is cut level by level, tried for circles, and its lines are checked Python objects. Estimating: "
        "iSAM2's own updates; what remains is association, which linearises factors too, and loops.",
        short=_QUICK,
        gated=True,
    ),
    "missions": Workload(
        "Simulated missions",
        "Poses unknown, many seeds: how good and how honest.",
        full={"runs": 20},
        short={"runs": 3, "scans": 200},
        on_request=True,
    ),
    "floorplans": Workload(
        "Floor plans",
        "Simulated office suites, a spinning laser of 5 mm, poses unknown: floor plans against the truth. "
        'NEES per degree of freedom, errors and sigmas in mm, of areas in dm^2; "drawn" with every plane measured '
        "replaced by the true one with an error of its own covariance.",
        short={"runs": 3},
        on_request=True,
    ),
    "candidates": Workload(
        "Candidates",
        "Which landmarks a keyframe's dozen observations may be, over the size of the map.",
        short=_QUICK,
        on_request=True,
    ),
    "load": Workload("Long sessions", "Sessions on disk under load.", on_request=True),
    "session": Workload("Sessions", "What keeping a session on disk costs.", on_request=True),
    "kill": Workload(
        "Runs that are killed",
        "Runs killed at random moments, sessions damaged at random places: what is lost.",
        short={"kills": 10, "damages": 10},
        on_request=True,
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
        on_request=True,
    ),
    "ablation": Workload(
        "Ablation",
        "The corpus with one mechanism at a time switched off: kinds of drive that get worse, and better, beyond the "
        "spread of their runs.",
        on_request=True,
    ),
}
