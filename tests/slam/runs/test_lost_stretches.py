"""A camera that saw nothing for seconds: what it sees then is found in what it saw before, and nowhere else."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.corpus.drives.disturbances import thinned
from benchmarks.corpus.handheld import make_handheld
from slam import PlaneSlam
from slam.backend.estimator import pose_symbol
from slam.config import SlamConfig
from slam.diagnostics.verdict import Verdict
from slam.frontend.input_checks import KeyframeError
from slam.frontend.keyframes import Keyframe, keyframes_of
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import inverse
from slam.io.default_rigs import depth_rig
from slam.registration.relocalization import displacement
from slam.runs.lost_stretches import found_stretches
from slam.runs.repair import assessed, repaired
from slam.session.store import Session
from spplanes._check import FloatArray
from spplanes.spmodel import transform_from_rpy
from tests.slam.scenes import run_of

#: Cameras that are covered for 3 s: what the first sees then fits nowhere, the second somewhere, by chance.
NOWHERE, BY_CHANCE = 4, 7
#: The first keyframe after that, of every second image.
START = 23


def seen(seed: int) -> tuple[list[Keyframe], FloatArray]:
    """The keyframes of a covered camera and their true poses."""
    drive = make_handheld("handheld/covered", seed)
    frames = list(keyframes_of(thinned(drive.log, 2), drive.rig, SlamConfig()))
    return frames, drive.truth.poses_at(np.array([frame.stamp_ns for frame in frames]))


@pytest.fixture(scope="module")
def cameras() -> dict[int, tuple[list[Keyframe], FloatArray]]:
    return {seed: seen(seed) for seed in (NOWHERE, BY_CHANCE)}


@pytest.fixture(scope="module", params=(NOWHERE, BY_CHANCE))
def run(
    request: pytest.FixtureRequest,
    cameras: dict[int, tuple[list[Keyframe], FloatArray]],
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, PlaneSlam, Verdict, FloatArray]:
    """A session, its run as it ended, the verdict on that, and the truth."""
    frames, truth = cameras[request.param]
    path = tmp_path_factory.mktemp("covered") / "session.db"
    slam = PlaneSlam.open(path, SlamConfig())
    run_of(frames, slam)
    return path, slam, assessed(slam, depth_rig()), truth


def test_a_stretch_is_found_as_sure_as_is_said(run: tuple[Path, PlaneSlam, Verdict, FloatArray]):
    _, slam, verdict, truth = run
    assert verdict.verdict == "doubtful"
    assert any(f"what was seen at keyframe {START} fits" in reason for reason in verdict.reasons)
    [found] = found_stretches(slam, verdict)
    assert found.start == START
    error = displacement(inverse(truth[found.match.keyframe]) @ truth[START], transform_from_rpy(found.match.delta))
    assert error @ np.linalg.solve(found.match.covariance, error) < chi2.ppf(0.999, 6)
    assert np.linalg.norm(error[:3]) < 0.03 < 0.5 < found.offset_m  # the map had it elsewhere


def test_the_run_is_mended_and_goes_on_as_it_was_mended(run: tuple[Path, PlaneSlam, Verdict, FloatArray]):
    path, slam, _, truth = run
    mended = repaired(slam, depth_rig())
    assert mended.verdict is not None and mended.verdict.verdict == "sound", mended.verdict
    [repair] = mended.repairs
    assert repair.stretches == 1 and "were found there by scans that agree" in repair.sentence
    poses = mended.slam.trajectory.poses
    off = inverse(poses[0]) @ poses[-1] - inverse(truth[0]) @ truth[-1]
    assert np.linalg.norm(off[:3, 3]) < 0.05
    mended.slam.close()
    with PlaneSlam.open(path, SlamConfig()) as again:
        np.testing.assert_array_equal(again.trajectory.poses, poses)
    with Session.open(path, read_only=True) as session:
        [place] = session.keyframe(START).places
        assert place.is_spatial


def test_another_room_is_not_taken_for_it(cameras: dict[int, tuple[list[Keyframe], FloatArray]]):
    """Carried elsewhere while it was covered: nothing of that is in the map."""
    (first, _), (second, _) = cameras.values()
    slam = PlaneSlam(SlamConfig())
    run_of([*first[:START], *second[START:]], slam)
    mended = repaired(slam, depth_rig())
    assert mended.repairs == () and mended.verdict is not None and mended.verdict.verdict != "sound"


@pytest.mark.parametrize("run", [NOWHERE], indirect=True)
def test_planes_of_two_stretches_are_not_matched(run: tuple[Path, PlaneSlam, Verdict, FloatArray]):
    """Where one lies in the other nobody knows: any plane is any other's then."""
    slam = run[1]
    assert slam.unplaced == [START]
    for landmark in slam.landmarks:
        frames = [sighting.keyframe for sighting in landmark.sightings]
        assert max(frames) < START or min(frames) >= START
    before, after = (np.trace(slam.marginal_covariance(pose_symbol(k))[3:, 3:]) for k in (START - 1, START))
    assert after > 10.0**2 * before  # and that is said


@pytest.mark.parametrize(
    ("delta", "covariance"),
    [(np.zeros(4), np.eye(6)), (np.zeros(6), np.eye(3)), (np.full(6, np.nan), np.eye(6)), (np.zeros(6), -np.eye(6))],
)
def test_places_that_are_none_are_refused(delta: FloatArray, covariance: FloatArray):
    slam = PlaneSlam(SlamConfig())
    slam.add_keyframe(Keyframe(0, []))
    with pytest.raises(KeyframeError, match="places"):
        slam.add_keyframe(Keyframe(1, [], places=(PlaceMatch(0, delta, covariance),)))
    assert len(slam.keyframes) == 1
