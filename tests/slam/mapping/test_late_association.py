"""Planes that were seen before their landmark was born."""

from dataclasses import replace

import numpy as np
from shapely import Polygon, box

from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam, SlamConfig
from spplanes import Plane
from tests.slam.scenes import drive, run_of

#: Whether a plane starts a landmark: a tilt of 0.2 rad is more than LandmarkConfig.max_tilt_sigma_rad.
UNCERTAIN = np.diag([0.01, 0.2, 0.2]) ** 2


def run(shift_m: float = 0.0, outline: Polygon | None = None, config: SlamConfig | None = None) -> PlaneSlam:
    """A drive whose first keyframe knows its last plane badly, moved along its normal, with an outline of its own."""
    frames: list[Keyframe] = drive(0, count=4).keyframes
    *seen, last = frames[0].observations
    frame = last.plane.frame.copy()
    frame[:3, 3] += shift_m * last.plane.normal
    uncertain = Plane(frame, UNCERTAIN, last.plane.n_points, outline or last.plane.outline)
    frames[0] = replace(frames[0], observations=[*seen, PlaneObservation(uncertain)])
    return run_of(frames, PlaneSlam(config))


def sightings(slam: PlaneSlam) -> list[int]:
    """Keyframes that saw the landmark born last."""
    return [one.keyframe for one in list(slam.landmarks)[-1].sightings]


def test_a_plane_too_uncertain_to_start_a_landmark_is_matched_once_it_is_there():
    slam = run()
    assert len(slam.landmarks) == 6 and sightings(slam) == [1, 0, 2, 3]
    [late] = slam.late_matches
    assert (late.at, late.keyframe, late.decision.observation) == (1, 0, 5)
    assert late.decision.match is not None and late.decision.match.chi2 < 16.3
    # its factor is in the graph: the batch of the same graph agrees
    assert slam.backend.values.size() == slam.optimize_batch().size()


def test_what_lies_elsewhere_or_is_the_edge_of_something_is_not():
    assert sightings(run(shift_m=0.3)) == sightings(run(outline=box(0.0, 0.0, 0.3, 0.3))) == [1, 2, 3]


def test_nothing_waits_longer_than_it_is_told_to():
    assert sightings(run(config=SlamConfig.model_validate({"landmarks": {"waiting_keyframes": 0}}))) == [1, 2, 3]
