"""Evidence: too little was seen, measured or put to use: an assumption or chance stands where a measurement should."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy.special import expit

from factors.association.observations import LineObservation, Observation, PlaneObservation
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import relative_covariance
from slam.diagnostics.evidence.innovations import PROMISED_M
from slam.diagnostics.verdict import Evidence, at_least, named
from slam.diagnostics.views import TOLERANCE_M
from slam.frontend.occupancy.raster import NOVEL_SHARE
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.mapping.map_update import may_start
from slam.mapping.observability import name_of, sigma_along
from slam.planeslam import PlaneSlam
from slam.registration.relocalization import sigmas_of
from spplanes._check import FloatArray

#: A sound run is wrong by a place taken for another more seldom than with this probability: that a run is wrong and
#: does not say so counts three times as much as that one is right and doubted.
MOST_WRONG = 0.25


def coverage_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Too few keyframes, an empty map, or a drive most of whose keyframes were placed by nothing that they saw.

    No statistic is needed: where nothing could have spoken against the map, that nothing did says nothing for it.
    """
    frames = range(len(run.keyframes))
    if len(frames) < 3:
        number = "1 keyframe" if len(frames) == 1 else f"{len(frames)} keyframes"
        yield _certain(frames, f"the run has only {number}: nothing was seen thrice")
        return
    wanted = run.config.landmarks.min_observations
    if not any(landmark.n_keyframes >= wanted and landmark.sightings for landmark in run.landmarks):
        yield _certain(frames, f"the map is empty: no plane was seen again at {named(frames)}")
        return
    if run.unplaced:
        lost = f"what was seen at {named(run.unplaced)} fits nowhere, and nobody measured the motion to there"
        yield _certain(run.unplaced, f"{lost}: an assumption alone placed them")
    blind = keyframes_without_wall(run)
    if 2 * len(blind) > len(frames) - 1:
        much = f"{len(blind)} of {len(frames) - 1} keyframes saw no wall that was known"
        yield _certain(blind, f"{much} ({named(blind)}): odometry or an assumption alone placed them")


def keyframes_without_wall(run: PlaneSlam) -> list[int]:
    """Keyframes after the first of whose observations none but those of floors and ceilings was matched, then or later.

    Floors and ceilings tell the height and the tilt, and nothing of where on the floor a body is.
    """
    matched, blind = _matched(run), []
    for index, pose in enumerate(run.trajectory.poses[1:], 1):
        seen = enumerate(run.keyframes[index].observations)
        normals = [observation.normal for k, observation in seen if (index, k) in matched]
        if not any(abs(pose[2, :3] @ normal) < 0.966 for normal in normals):  # nearer to level, 15 deg, it is a floor
            blind.append(index)
    return blind


def _matched(run: PlaneSlam) -> set[tuple[int, int]]:
    """(keyframe, observation) of all that was matched, then or later."""
    matched = {(match.keyframe, match.decision.observation) for match in run.late_matches}
    for index, decisions in enumerate(run.decisions):
        matched |= {(index, decision.observation) for decision in decisions if decision.match is not None}
    return matched


def _certain(keyframes: Sequence[int], sentence: str) -> Evidence:
    return Evidence("coverage", "doubtful", 0.0, float(len(keyframes)), "keyframes", tuple(keyframes), sentence)


def assumption_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Directions that the map leaves open where no motion was measured, known by all means to no better than 0.1 m.

    After wheels stood, and where planes are all that was seen, what these leave open is told by nothing later: planes
    look alike. Constant velocity is an assumption, and so is the sigma that follows from it: in a bare corridor a robot
    that stops for a while stands where the map does not know. What matched the scans of a laser without wheels knows
    there no more than that. Odometry that was found wrong, and left aside for an assumption, or that returns refute
    and leave open, is none. No statistic is needed. A few motions that nobody measured are not what a map is unsure of
    where all else adds up to more: what the graph leaves open of them alone must, erring all the same way.
    """
    if run.left_open:
        frames, sigma = tuple(run.left_open), max(run.left_open.values())
        sentence = (
            f"nobody measured the motion to {named(frames)}, and the planes seen there left it open (sigma up to "
            f"{sigma:.2g} m): any plane alike would have been taken for one of the map"
        )
        yield Evidence("assumption", "doubtful", 0.0, sigma, "m", frames, sentence)
    motions = enumerate(frame.motion for frame in run.keyframes)
    assumed = {index for index, motion in motions if index and not (motion is not None and _is_told(motion))}
    assumed |= {step.keyframe for step in run.odometry_record.steps if step.used == "not"}
    if not assumed:
        return
    for one in run.open_in_map:
        if one.part != "position":
            continue
        sigmas = {frame: sigma_along("position", one.direction, frame, run.backend) for frame in one.keyframes}
        unsure = [frame for frame, sigma in sigmas.items() if sigma > PROMISED_M]
        since = _adrift_since(run, one.direction, assumed) if unsure else np.inf
        wide = tuple(frame for frame in unsure if frame >= since)
        if wide:
            sigma = max(sigmas[frame] for frame in wide)
            sentence = (
                f"{name_of(one.part, one.direction)} nobody measured the motion and nothing that was seen tells it at "
                f"{named(wide)}: that the body went on as before is an assumption (sigma up to {sigma:.2g} m)"
            )
            yield Evidence("assumption", "doubtful", 0.0, sigma, "m", wide, sentence)


def _adrift_since(run: PlaneSlam, direction: FloatArray, assumed: set[int]) -> float:
    """The first keyframe that assumed motions, all off the same way, move by more than 0.1 m along a direction."""
    held = [frame for frame in range(len(run.keyframes)) if run.backend.holds(pose_symbol(frame))]
    total = 0.0
    for start, end in pairwise(held):
        if assumed.isdisjoint(range(start + 1, end + 1)):
            continue
        keys = [pose_symbol(start), pose_symbol(end)]
        world_T_end = run.backend.pose(keys[1])
        joint = run.backend.read_joint_covariance(keys, shared=False).of(keys)
        covariance = relative_covariance(inverse(run.backend.pose(keys[0])) @ world_T_end, joint)[:3, :3]
        along = world_T_end[:3, :3].T @ direction
        total += float(np.sqrt(max(along @ covariance @ along, 0.0)))
        if total > PROMISED_M:
            return end
    return np.inf


def _is_told(motion: Motion) -> bool:
    """Whether wheels measured a motion, or returns that refute them tell it as sharply as a sound run is known."""
    if motion.refuted_a_T_b is None or motion.scan_matched is None:
        return motion.is_measured
    return sigmas_of(motion.scan_matched)[0] <= PROMISED_M


def ambiguity_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Places found by what was seen alone, where other places fit as well: with what probability one of them is wrong.

    A row of pillars looks the same from one pillar on, a hall from both of its ends.
    """
    right = float(np.prod([1.0 - rival.probability for rival in run.rivals.values()]))
    if right >= 1.0 - MOST_WRONG:
        return
    likely = [
        frame for frame, rival in run.rivals.items() if rival.probability > (1.0 - right) / (2.0 * len(run.rivals))
    ]
    worst = max(likely, key=lambda frame: run.rivals[frame].probability)
    probability, distance_m, angle_rad, unseen = run.rivals[worst]
    other = f"{distance_m:.1f} m and {np.rad2deg(angle_rad):.0f} deg off at {named((worst,))}"
    fits = f"fits other places nearly as well, {other}"
    if 2.0 * unseen > probability:
        fits = "fits where it was placed no better than it would by chance"
    sentence = (
        f"what was seen at {named(likely)} {fits}: with probability {1.0 - right:.2f} one of those chosen is wrong"
    )
    yield Evidence("ambiguity", "doubtful", 0.0, 1.0 - right, "probability", tuple(likely), sentence)


def waiting_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Loops that were likelier than all else together, and wait to the end for another that bears them out.

    It matters where the map has them elsewhere: likelier than not it is wrong there. A drive that ends as it comes back
    has nothing more to say.
    """
    poses = run.trajectory.poses
    waiting = [loop.proposal for loop in run.loops if loop.verdict == "waiting" and loop.proposal is not None]
    apart = [one for one in waiting if one.offset_m(poses) > TOLERANCE_M]
    if not apart:
        return
    likeliest = max(apart, key=lambda one: one.log_odds)
    ends = tuple(sorted({end for one in apart for end in (one.old_keyframe, one.keyframe)}))
    sentence = (
        f"what was seen at {named((likeliest.keyframe,))} fits what was seen at {named((likeliest.old_keyframe,))} "
        f"better {likeliest.offset_m(poses):.2g} m from where the map has it, and no other loop bears it out"
    )
    yield Evidence("loops", "doubtful", 0.0, float(expit(likeliest.log_odds)), "probability", ends, sentence)


def unmatched_evidence(run: PlaneSlam) -> Iterator[Evidence]:
    """Keyframes of whose surfaces, by area or by length, more than `NOVEL_SHARE` is of no plane that is seen twice.

    What is new is seen again from the next keyframe, or is clutter. In a sound run at most every second keyframe has
    more of it than that: a sign test. What may start no landmark could not be seen again, and says nothing: over a
    desk that is most of what a camera sees.
    """
    known = _matched(run) | {
        (sighting.keyframe, sighting.observation)
        for landmark in run.landmarks
        if landmark.n_keyframes > 1
        for sighting in landmark.sightings
    }
    shares: dict[int, float] = {}
    for index in range(1, len(run.keyframes) - 1):  # the first has nothing to match, the last is seen by none again
        seen = run.keyframes[index].observations
        matched = np.array([(index, k) in known for k in range(len(seen))], dtype=bool)
        telling = [again or may_start(one, run.config.landmarks) for again, one in zip(matched, seen, strict=True)]
        sizes = np.array([_extent(one) for one in seen]) * telling
        if sizes.any():
            shares[index] = float(sizes[~matched].sum() / sizes.sum())
    frames = tuple(index for index, share in shares.items() if share > NOVEL_SHARE)
    if not frames:
        return
    count, size = len(shares), float(np.median(list(shares.values())))
    p_value = float(at_least(len(frames), count))
    sentence = (
        f"{len(frames)} of {count} keyframes ({named(frames)}) see more that is never seen again than can be new: "
        f"{100.0 * size:.0f} % of a typical one's surfaces match nothing"
    )
    yield Evidence("unmatched", "doubtful", p_value, size, "of the area seen", frames, sentence)


def _extent(observation: Observation) -> float:
    """Area of a plane, m^2, length of a line, m."""
    if isinstance(observation, LineObservation):
        return observation.line.length
    if isinstance(observation, PlaneObservation) and observation.plane.outline is not None:
        return observation.plane.outline.area
    return 0.0
