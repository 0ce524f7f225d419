"""Evidence: places that look like one, and the graph will not have them so."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from slam.diagnostics.evidence._binomial import at_least
from slam.diagnostics.verdict import Evidence, named
from slam.loop_closure.verification import LoopDecision


def loop_evidence(loops: Sequence[LoopDecision], significance: float) -> Iterator[Evidence]:
    """Loops that verification was sure of, to `significance`, and that contradict the estimate.

    They were refused because the graph as a whole was against them, or because they lie beyond all that it may have
    drifted. One such comparison may be of places that only look alike, as often as the significance says; more are an
    estimate that is wrong.
    """
    against = [one for one in loops if one.verdict in ("refused", "far")]
    if not against:
        return
    frames = tuple(sorted({frame for one in against for frame in (one.old_keyframe, one.keyframe)}))
    offsets = [one.offset_m for one in against if np.isfinite(one.offset_m)]
    much = f", up to {max(offsets):.2g} m from where the map has them" if offsets else ""
    yield Evidence(
        "loops",
        "doubtful",
        float(at_least(len(against), len(loops), significance)),
        float(len(against)),
        "loops",
        frames,
        f"{len(against)} of {len(loops)} comparisons with old places found the same place and were refused by the map "
        f"({named(frames)}{much})",
    )
