"""Errors put into the sources one by one, each with the tests that must notice: is a test lost, or too weak?

Usage: python tools/mutations.py [NUMBER]...

Every one is made in a copy of this clone, in a process of its own; the tests named pass before and fail after. Exit
code 1 where a test fails without an error or none fails with one. By hand, when tests were thinned out: a few minutes.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple, Self

PROJECT = Path(__file__).resolve().parent.parent
_LEFT_OUT = shutil.ignore_patterns(".git", ".venv", "build", "demo", ".pytest_cache", ".hypothesis")
#: Imported once: what all processes need and takes longest to import.
_OTHERS = ("numpy", "numba", "gtsam", "scipy.stats", "shapely", "pytest", "typer", "pydantic")
#: Each in words; the source, and the tests that must fail; what is there, once (-), and what comes in its place (+).
_TABLE = r"""
conventions: a flipped tilt of planes
factors/_conventions.py  tests/factors/test_conventions.py
-matrices[:, 2, :2] = -np.einsum
+matrices[:, 2, :2] = np.einsum

factors: planes twice as sure as they state
factors/_conventions.py  tests/slam/test_planeslam.py::test_final_poses_and_planes_are_consistent_over_many_runs
-return np.asarray(np.linalg.qr(whitener,
+return np.asarray(np.linalg.qr(np.sqrt(2.0) * whitener,

odometry: what is unsure of a jump is not carried on to where the motion ends
slam/frontend/odometry.py  tests/slam/frontend/test_odometry_jumps.py
-more = carried @ self._change @ carried.T
+more = self._change

lines: what is stated of the noise is a guess
spplanes/lines/extraction.py  tests/spplanes/lines/test_shared_error.py
-covariances, stated=True
+covariances, stated=False

logs: a laser that hangs is believed
slam/io/plausibility.py  tests/slam/io/test_plausibility.py
-if len(again) >= _FEW
+if len(again) < 0

rounding: of two values that are seen nothing is left
spplanes/fitting/rounding.py  tests/spplanes/fitting/test_rounding.py
-np.maximum(1.0 - 4.0 * scatter, by_noise)
+by_noise

velocity: a step that was drawn to what was expected tells as if it was not
slam/frontend/laser_odometry/velocity.py  tests/slam/frontend/test_velocity.py
-(moved - expected[0]) / np.maximum(gain, _TOLD)
+0.1 * (moved - expected[0])

verdict: what may start no landmark is missed where it is never seen again
slam/diagnostics/evidence/coverage.py  tests/slam/diagnostics/evidence/test_look.py
-again or may_start(one, run.config.landmarks)
+True

verdict: what is confirmed may be seen through as well
slam/diagnostics/views.py  tests/slam/diagnostics/test_views.py
-(view.sees_through(places) & ~confirmed)
+(view.sees_through(places))

verdict: matched scans measure a motion
slam/diagnostics/evidence/coverage.py  tests/slam/diagnostics/evidence/test_coverage.py
-return motion.is_measured
+return True

lines: what is stated of walls is forgotten where residuals show less
spplanes/lines/extraction.py  tests/spplanes/lines/test_shared_error.py
-np.maximum(stated - shown, 0.0)
+0.0 * stated

search: what lies beyond a submap's table is looked up at its rim's neighbour
slam/registration/correlative_search.py  tests/slam/registration/test_correlative_search.py
-self._origin - (reach + 1) * CELL_M
+self._origin - reach * CELL_M

search: blocks of motions do not reach back into a raster from beside it
slam/registration/correlative_search.py  tests/slam/registration/test_place_views.py
-_widened(np.pad(self._whole, reach + 1), reach)
+np.pad(_widened(self._whole, reach), reach + 1)

search: a place as wide as its witnesses alone leave it
slam/registration/correlative_search.py  tests/slam/registration/test_correlative_search.py
-poses - mean, poses - mean) / looks
+poses - mean, poses - mean)

warp: walls in pieces are looked at twice
slam/frontend/warp_calibration.py  tests/slam/frontend/test_warp_calibration.py
-range(6):  # looks
+range(2):

warp: walls taken for as flat as the noise of their beams
slam/frontend/warp_calibration.py  tests/slam/frontend/test_warp_calibration.py::test_uneven_walls_are_no_warp
-+ shared.octave_sigmas_m[k] ** 2 * _uneven(local[k])

fitting: the slope that says where neighbours share an error, without what is expected
spplanes/fitting/shared_error.py  tests/spplanes/fitting/test_shared_error.py
-[..., 0]).sum(axis=1) - expected
+[..., 0]).sum(axis=1)

fitting: surfaces of one cloud taken to be alike
spplanes/fitting/shared_error.py  tests/spplanes/fitting/test_shared_error.py
-np.array([0.3, 0.6, 1.0, 1.5, 2.0, 3.0])
+np.array([0.03])

fitting: how uneven a surface is, by its own contrasts alone
spplanes/fitting/shared_error.py  tests/spplanes/fitting/test_shared_error.py
-return _of_a_population(relative, taus)
+return least, taus[likelihoods.argmax(axis=1)]

warp: planes without tilts of their own
slam/frontend/warp_calibration.py  tests/slam/frontend/test_warp_calibration.py
-own, _ = np.linalg.qr(white[:, :3])
+own, _ = np.linalg.qr(white[:, :1])

tracking: the next motion as sure as if the one before were known
slam/tracking/prediction.py  tests/slam/tracking/test_constant_velocity.py
-total = total + (ahead_s / before_s) ** 2 * covariance
+total = total + 0.0 * covariance

fitting: the distance of a plane without its lever arm
spplanes/_hesse.py  tests/spplanes/test_plane.py
-inverse[0, :3] = -(x @ c) * x - (y @ c) * y

fitting: pose errors stay where they are while they are integrated out
spplanes/fitting/_shared_pose.py
tests/spplanes/fitting/test_joint_pose.py::test_the_plane_is_the_likeliest_whatever_the_tilts_were
-u - follow @ step
+u

covariance: of a motion, turned the wrong way
slam/frontend/odometry.py
tests/slam/frontend/test_push_broom.py::test_spatial_covariance_turns_into_the_axes_of_the_second_pose
-turn[:3, :3] = a_T_b[:3, :3].T
+turn[:3, :3] = a_T_b[:3, :3]

covariance: of a line's shift and turn, correlated the other way
spplanes/line.py  tests/slam/frontend/test_observations.py
-((along, -1.0), (1.0, 0.0))
+((along, 1.0), (1.0, 0.0))

covariance: of a wall that is not straight, about the wrong end
factors/association/observations.py  tests/slam/frontend/test_observations.py
-((1.0, 0.0), (middle, 1.0))
+((1.0, 0.0), (-middle, 1.0))

segmentation: patches that meet at a crease stay one plane
spplanes/segmentation/pipeline.py
tests/spplanes/segmentation/test_segment_scans.py tests/spplanes/segmentation/test_splitting.py
-part_at_creases(sheet, views, config)
+pass

segmentation: cells off their plane stay in it
spplanes/segmentation/pipeline.py  tests/spplanes/segmentation/test_segment_scans.py
-release_misfits(sheet, config)
+pass

association: what is no match is a new plane
factors/association/decisions.py  tests/slam/map/test_data_association.py
-"unsure" if near else "new"
+"new"

association: whatever is near is a match, however unlikely
factors/association/decisions.py  tests/slam/map/test_data_association.py
-if candidate.p_value >= gates.significance and candidate.log_likelihood >= none and
+if

loop closure: the way back to the first axes with the wrong sign
slam/registration/submaps.py  tests/slam/loop_closure/test_pairwise_consistency.py
-self.delta[1] - delta[1], delta[0] - self.delta[0]
+delta[1] - self.delta[1], self.delta[0] - delta[0]

loop closure: closures agree that are ten times too far apart
slam/loop_closure/pairwise_consistency.py  tests/slam/loop_closure/test_pairwise_consistency.py
-return chi2 <= float(
+return chi2 <= 100.0 * float(

verdict: looking at more doubts more
slam/diagnostics/verdict.py  tests/slam/diagnostics/test_verdict.py
-SIGNIFICANCE / max(kinds, 1)
+SIGNIFICANCE

odometry: errors of what saw it counted as its own
slam/tracking/odometry_scale.py  tests/slam/tracking/test_odometry_scale.py
-log_density(off[axes], stated + covariance[grid])
+log_density(off[axes], stated)

odometry: next to no step is a slip
slam/tracking/odometry_scale.py  tests/slam/tracking/test_odometry_scale.py
-SLIPS = 0.1
+SLIPS = 1e-3

calibration: twice as sure of the wheels' errors as the graph is
slam/tracking/calibration_by_graph.py
tests/slam/tracking/test_calibration_by_graph.py::test_errors_of_calibration_are_honest_and_what_a_rig_states_is_believed
-covariance = some * (0.5 *
+covariance = some * (0.25 *

audit: innovations by one linearisation
slam/mapping/consistency.py
tests/slam/mapping/test_consistency.py::test_long_walls_agree_with_each_other_though_wheels_know_the_heading_badly
-jacobian, residual, ends = linear.at(change)
+ends = linear.at()[2]

association: linearised where wheels lead, not returns
factors/association/joint_association.py
tests/slam/mapping/test_consistency.py::test_long_walls_agree_with_each_other_though_wheels_know_the_heading_badly
-joint, there, estimate, change) for one
+joint, values, estimate) for one

calibration: a scale is told by the way as measured
slam/frontend/wheel_calibration.py
tests/slam/tracking/test_calibration_by_graph.py::test_a_scale_that_nothing_tells_is_not_found
-response[:2, 0] = a_T_b[:2, 3]
+response[:2, 0] = motion.a_T_b[:2, 3]

repair: stretches as the estimate bends them
slam/loop_closure/whole_drive.py  tests/slam/runs/test_repair.py
-list(reckoned[first:last]), reckoned[frame], config
+list(poses[first:last]), poses[frame], config

calibration: what was seen since is forgotten
slam/tracking/calibration_by_graph.py
tests/slam/tracking/test_calibration_by_graph.py::test_what_is_seen_after_the_graph_was_asked_is_counted_too
-graph.known(found.covariance + np.outer(since, since))
+graph.known(found.covariance)

calibration: what steps share is left out of the covariances
slam/backend/estimator.py
tests/slam/tracking/test_calibration_by_graph.py::test_poses_far_from_what_was_seen_are_honest
-for unknown in self._shared() if shared else ():
+for unknown in ():

back end: what Cholesky cannot eliminate is tried by Cholesky again
slam/backend/elimination.py  tests/slam/backend/test_estimator.py
-twin = self._empty("QR")
+twin = self._empty("CHOLESKY")

prior map: its planes as if they were independent
slam/session/prior_map.py
tests/slam/session/test_prior_map.py::test_what_planes_of_a_map_share_is_what_the_graph_says_they_do
-return jacobian @ joint.full @ jacobian.T
+full = jacobian @ joint.full @ jacobian.T
+    return full * np.kron(np.eye(len(owners)), np.ones((3, 3)))

joining: a tie's derivative without the anchor
slam/joining/solution.py  tests/slam/joining/test_exactness.py
-by_b @ adjoints[1], by_b
+by_b, by_b

joining: one of two maps taken for exact
slam/joining/alignment.py  tests/slam/joining/test_joining.py::test_chi2_of_the_common_planes_is_chi2
-spread = a.covariance_of(rows_a) + by_b @ b.covariance_of(rows_b) @ by_b.T
+spread = a.covariance_of(rows_a)

poses at scans: half of a disagreement wherever the scan is
slam/runs/scan_trajectory.py
tests/slam/runs/test_scan_trajectory.py::test_a_disagreement_is_spread_along_the_way_and_not_while_the_robot_stands
-gtsam.Pose3.Expmap(share * step)
+gtsam.Pose3.Expmap(0.5 * step)

io: a laser's place in the frame of the robot, turned the wrong way
slam/io/carmen.py  tests/slam/io/test_carmen.py
-c * dx + s * dy, -s * dx + c * dy, turn
+c * dx - s * dy, s * dx + c * dy, turn

io: quaternions that are none are taken
slam/geometry/frames.py  tests/slam/geometry/test_frames.py tests/slam/io/test_trajectories.py
-NORM_TOLERANCE = 1e-3
+NORM_TOLERANCE = 1e3

io: rotations that are none are taken
slam/io/trajectories.py  tests/fuzz/test_targets.py::test_what_was_found_stays_found tests/slam/io/test_trajectories.py
-proper = (errors <= NORM_TOLERANCE) & (
+proper = ~(errors < 0.0) & (

session: keyframes whose checksum is wrong are read
slam/session/_records.py  tests/slam/session/test_store.py::test_nothing_changed_is_read_as_truth
-if row is None or digest(self._digest_of(index - 1), index, row[0], row[1]) != row[2]:
+if row is None:

session: a resumed run measures its last keyframe again
slam/runs/slam_run.py  tests/slam/session/test_resume.py::test_a_run_that_ended_early_goes_on_to_the_same_result
-keyframes_of(log, rig, config, done_before,
+keyframes_of(log, rig, config, max(done_before - 1, 0),

session: decisions are not compared with those recorded
slam/session/replay.py  tests/slam/session/test_store.py::test_decisions_are_recorded_and_compared
-_check_same(f"{self.session.path}: keyframe {index}", recorded, decisions)
+pass

evaluation: a plane turned the wrong way onto the truth
slam/evaluation/trajectories.py  tests/slam/evaluation/test_trajectories_and_planes.py
-np.arctan2(cross[1, 0] - cross[0, 1],
+np.arctan2(cross[0, 1] - cross[1, 0],

association: of joint hypotheses it does not count how far a landmark was seen from what it is
factors/association/joint_association.py  tests/factors/test_association.py -k one_wall
-return candidate.log_likelihood - self.gaps.away(index, candidate.landmark)
+return candidate.log_likelihood

association: the anchor's own drift counts for the pose
factors/association/shortlist.py  tests/factors/test_association.py -k goes_on
-np.hstack((skew(there[:3]), -np.eye(3)))
+np.hstack((skew(there[:3]), np.eye(3)))

odometry against 3D scans: what stands close speaks by its share of the view
slam/registration/surface_registration.py  tests/slam/registration/test_surface_registration.py -k close_by
-number, points = number + 1, points[~one]
+number, points = number + np.count_nonzero(one), points[~one]

odometry against 3D scans: a slip leads nowhere in particular for nothing
slam/tracking/odometry_check.py  tests/slam/tracking/test_odometry_check.py -k fit_as_well
-return elsewhere.log_odds(there) - spread
+return elsewhere.log_odds(there)

scans: grids of holes are searched along their rows
slam/frontend/measurement.py  tests/slam/registration/test_scans_alone.py -k seen_in_part
-return points if are_linked(np.isfinite(points[..., 0])) else
+return points if True else

places of a scan: one that nothing fits is as likely as one that is alike
slam/registration/surface_registration.py  tests/slam/registration/test_surface_registration.py -k much_worse
-return prior - less * (TELLING + _TELLING_AS_A_SQUARE * weight * less)
+return prior - less * TELLING

lost stretches: where pairs of scans agree nothing else is asked
slam/runs/lost_stretches.py  tests/slam/runs/test_lost_stretches.py -k another_room
-return judge(match, _AS_FOUND).verdict == "sound"
+return True

lost stretches: their planes are matched to any of before
slam/planeslam.py  tests/slam/runs/test_lost_stretches.py -k not_matched
-if start else None
+if False else None

places of a scan: it was seen before in any case
slam/registration/relocalization.py  tests/slam/runs/test_lost_stretches.py -k as_sure
-unseen *= max(float(
+unseen *= 0.0 * max(float(

sensors that hang: a scan to the last bit as before is a new one
slam/frontend/input_checks.py  tests/slam/runs/test_bad_input.py -k hangs
-or not np.array_equal(surfaces, seen)
+or True

verdict: one motion that nobody measured makes all that follows an assumption
slam/diagnostics/evidence/coverage.py  tests/slam/diagnostics/evidence/test_coverage.py -k few_short
-if total > PROMISED_M:
-            return end
+return end

CARMEN: records that were stamped late are spread from nowhere
slam/io/carmen.py  tests/slam/io/test_carmen.py -k held_up
-starts = np.concatenate((ends[:1], ends[:-1]))
+starts = np.concatenate((ends[:1], ends[:1] + 0 * ends[:-1]))

odometry against 3D scans: elements as wide as of dense scans, however far beams are apart
slam/frontend/scan_surfaces.py  tests/slam/tracking/test_odometry_check.py -k jumps
-max(share, 2.0 * every
+min(share, 2.0 * every

odometry against 3D scans: a motion as the body makes none is believed where it fits somehow
slam/tracking/odometry_check.py  tests/slam/tracking/test_odometry_check.py -k jumps
-if not doubted and steady:
+if not doubted:  # and steady

odometry against 3D scans: a scan that slid to where it meets nothing contradicts nothing
slam/tracking/odometry_check.py  tests/slam/tracking/test_odometry_check.py -k in_a_turn
-if (found if is_near else held()).score >= 0.0:
+if found.score >= 0.0:

odometry against 3D scans: planes confirm what they contradict by less than fits are off at times
slam/tracking/odometry_check.py  tests/slam/tracking/test_odometry_check.py -k slip_of
-not _agree(motion, place, fitted, significance):
+not _agree(motion, place, by_planes, significance):

verdict: what rests on odometry that was left aside is doubtful
slam/diagnostics/evidence/innovations.py  tests/slam/tracking/test_odometry_check.py -k in_a_turn
-if k and k not in unused and motion
+if k and motion

odometry against 3D scans: what they say of a step that is off is forgotten
slam/tracking/prediction.py  tests/slam/tracking/test_odometry_check.py -k put_to_use
-return used, prior, place_of(keyframe, used, laid, *about)
+return used, prior, None

odometry of a push-broom robot: wheels that stand have measured
slam/frontend/laser_odometry/stalled_wheels.py  tests/slam/frontend/test_stalled_wheels.py
-return bool(np.any((nearer > 0.5) | (farther > 0.15)))
+return bool(np.any(nearer > 1.0))

odometry against 3D scans: a place that was looked for elsewhere never speaks against a motion
slam/tracking/odometry_check.py  tests/slam/tracking/test_odometry_check.py -k jumps
-    if is_off(rival):
+    if not is_off(rival):

motions nobody measured: what was not seen tells how steadily the body moves
slam/registration/motion_prior.py  tests/slam/registration/test_motion_prior.py -k nothing_is_learnt
-told = np.diag(known) <= _TOLD * np.diag(used.covariance)
+pass

motions nobody measured: shares below the noise of steps count as if they were told
slam/frontend/steadiness.py  tests/slam/frontend/test_steadiness.py
-shares = np.sqrt(np.einsum("sra,s->a", weights, _SHARES**2))
+shares = np.exp(np.einsum("sra,s->a", weights, np.log(_SHARES)))

motions nobody measured: places are told apart by what any body may do
slam/registration/surface_registration.py  tests/slam/registration/test_motion_prior.py -k told_apart
-if self.prior is not None:
+if False:

odometry against 3D scans: scores of elements, however wide they are
slam/frontend/scan_surfaces.py  tests/slam/registration/test_surface_registration.py -k things
-things = np.minimum(elements[:, WIDTH] / THING_M, 1.0) ** 2
+things = np.ones(len(elements))

places of 3D scans: planes count by their area, so that the floor tells where a camera is
slam/frontend/scan_surfaces.py  tests/slam/registration/test_surface_registration.py -k floor
-things[on_plane] /= np.sqrt(np.bincount(plane, things[on_plane]))[plane]
+pass

odometry: what is expected is judged by steps that slipped alone
slam/tracking/odometry_record.py  tests/slam/tracking/test_odometry_record.py
-return bool(slips * expected + (1.0 - slips) * other < slips * measured)
+return bool(expected < measured)

odometry: wheels that slipped a step ago are as fine as ever
slam/tracking/odometry_record.py  tests/slam/tracking/test_odometry_record.py
-return _AGAIN * self._slipped
+return _AGAIN * float(self._slipped == 1.0)

measurement: planes on either side of a bend reach up to it
spplanes/segmentation/validation/bends.py  tests/slam/frontend/test_measurement.py -k blunt_corner
-return along < self.between_m[0], along > self.between_m[1]
+return along < np.mean(self.between_m), along > np.mean(self.between_m)

measurement: steps are looked for as bends are
spplanes/segmentation/validation/bends.py  tests/slam/frontend/test_measurement.py -k no_bend
-np.repeat((0.0, 4.6), places.size)
+np.repeat((0.0, 0.0), places.size)

lines are looked for once, by less noise than beams have
spplanes/lines/extraction.py  tests/spplanes/lines/test_statistics.py -k beams_scatter
-return _scatter(scans, seen, config) if seen > sigma else (seen, telling)
+return seen, telling

which points may be of two planes is told by their errors
spplanes/fitting/seams.py  tests/spplanes/fitting/test_seams.py tests/spplanes/segmentation/test_plane_ends.py
-apart -= ratio * off

points weigh by their own range
spplanes/segmentation/cloud_search.py  tests/spplanes/segmentation/test_cloud.py -k as_sure_as_they_say
-ranges = ranges * np.clip(share, 0.5, 2.0)

a laser that nobody describes has the noise of a data sheet
slam/io/default_rigs.py  tests/slam/sensors/test_rig.py
-seen_m = shown_by_lines(sensor, scans) or TYPICAL_BEAM_SIGMA_M
+seen_m = TYPICAL_BEAM_SIGMA_M

loops that wait to the end are forgotten
slam/diagnostics/evidence/coverage.py  tests/slam/diagnostics/evidence/test_coverage.py
-if one.offset_m(poses) > TOLERANCE_M]
+if one.offset_m(poses) < 0.0]

what is asked about stays deep in the tree
slam/backend/estimator.py  tests/slam/backend/test_estimator.py
-self._bring_up(keys)
+pass

repair: a start found in the prior map leaves the floor
slam/runs/repair.py  tests/slam/runs/test_repair.py
-off[list(PLANE)] = 0.0
+pass

session: the start that was found is forgotten
slam/session/replay.py  tests/slam/runs/test_repair.py
-prior = replace(prior, world_T_start=session.start)
+pass

verdict: all rays of a push-broom laser begin at its keyframe
slam/diagnostics/evidence/surfaces.py  tests/slam/diagnostics/evidence/test_coverage.py
-sight.ends[:, 2:] / ahead[2] * ahead if moves_on else sight.starts
+sight.starts

verdict: what planes leave open after wheels stood is forgotten
slam/tracking/prediction.py  tests/slam/frontend/test_stalled_wheels.py
-self.left_open[index] = sigmas_of(found)[0]
+pass

clouds: scatter along beams is taken to grow where beams graze
spplanes/clouds/scatter.py  tests/spplanes/segmentation/test_cloud.py -k noise_lies_along
-squares - 2.0 * np.log(
+squares + 2.0 * np.log(

registration: patches know what noise of their directions makes them seem to know
slam/registration/surface_registration.py  tests/slam/registration/test_noisy_directions.py -k tilts
-return by_others + scale @ by_tilted @ scale
+return by_others + by_tilted

odometry: planes that turn while wheels stand say nothing
slam/tracking/odometry_check.py  tests/slam/tracking/test_standing_wheels.py -k hang
-return Check(True, by_planes, displacement(np.eye(4), place), fitted)
+return None

verdict: refuted wheels measure what the returns leave open
slam/diagnostics/evidence/coverage.py  tests/slam/tracking/test_standing_wheels.py -k hang
-return sigmas_of(motion.scan_matched)[0] <= PROMISED_M
+return True

velocity: the pose before errs to the wrong side
factors/_custom.py  tests/factors/test_velocity.py
-jacobians[0] = -by_first @
+jacobians[0] = by_first @

tracking: a motion that nobody measured changes as much as its velocity is unknown
slam/tracking/prediction.py  tests/slam/tracking/test_constant_velocity.py
-change = np.diag(motion.covariance) - prior.before
+change = np.diag(motion.covariance)

tracking: motions that nobody measured err each by itself
slam/tracking/prediction.py  tests/slam/tracking/test_constant_velocity.py
-step = motion.factor(before, key) if assumed is None else
+step = motion.factor(before, key) if True else

tracking: a body that nobody saw for a while is where it was led
slam/registration/motion_prior.py  tests/slam/registration/test_motion_prior.py
-return self.before + self.adrift + (
+return self.before + (

tracking: a body starts where its last keyframe is, seen or not
slam/tracking/prediction.py  tests/slam/tracking/test_constant_velocity.py
-if keyframe.observations or scan_of(keyframe) is not None:
+if True:

registration: only the newest keyframe speaks against a place
slam/registration/surface_registration.py  tests/slam/registration/test_surface_registration.py
-fit.close - _CONTRADICTION * float(against[name].mean())
+fit.close - _CONTRADICTION * float(against[name][-1])

registration: a scan is laid from what is expected and from where nothing moved alone
slam/registration/relocalization.py  tests/slam/registration/test_surface_registration.py
-proposed = [there @ turn for turn in _TURNED] if by_planes is None
+proposed = [] if by_planes is None

turns: what is seen last is taken for the first
slam/frontend/deskewing.py  tests/slam/frontend/test_turning_lidars.py
-share = np.nan_to_num(begin.turned(flat)) * _PARTS
+share = np.nan_to_num(1.0 - begin.turned(flat)) * _PARTS

turns: planes do not err by the motion within them
slam/frontend/deskewing.py  tests/slam/frontend/test_turning_lidars.py
-plane.covariance + errs @ self.twist_covariance @ errs.T
+plane.covariance

turns: clouds before are bent the other way
slam/tracking/turns.py  tests/slam/runs/test_turning_lidars.py
-by_time[every, theirs[:, _PART].astype(int)] -= np.einsum
+by_time[every, theirs[:, _PART].astype(int)] += np.einsum

turns: of two clouds one is bent the other way
slam/tracking/bent_pair.py  tests/slam/tracking/test_bent_pair.py
-by_motions = -_by_twist(theirs, normals),
+by_motions = _by_twist(theirs, normals),

association: planes beside a landmark are never another one
factors/association/joint_association.py  tests/factors/test_association.py -k lies_beside
-> 0.0]
+> 1e9]

camera: what is left open tilts planes the other way
slam/sensors/rig.py  tests/slam/mapping/test_calibration_errors.py
--slopes[0], slopes[1]
+slopes[0], slopes[1]

camera: all that is left open of it is as unsure as before the map
slam/mapping/calibration_errors.py  tests/slam/mapping/test_calibration_errors.py
-graph.known(covariance + np.outer(mean, mean))
+graph.known(np.eye(count) + np.outer(mean, mean))

camera: what the map says of its errors is not considered
slam/mapping/calibration_errors.py  tests/slam/mapping/test_calibration_errors.py
-(covariance + np.outer(mean, mean))
+(covariance)

prior map: of planes taken for one the younger comes into the graph again
slam/mapping/fusion.py  tests/slam/session/test_prior_map.py -k part_again
-initial=not self._backend.has_plane(back.key)
+initial=True
"""


class Mutation(NamedTuple):
    """One error."""

    what: str
    path: str
    right: str
    wrong: str
    tests: list[str]

    @classmethod
    def parse(cls, block: str) -> Self:
        """From its lines in the table."""
        what, *lines = block.splitlines()
        right, wrong = ("\n".join(line[1:] for line in lines if line[0] == sign) for sign in "-+")
        path, *tests = " ".join(line for line in lines if line[0] not in "-+").split()
        return cls(what, path, right, wrong, tests)


MUTATIONS = [Mutation.parse(block) for block in _TABLE.strip().split("\n\n")]


def main(words: list[str]) -> int:
    """Make the errors of these numbers, or all; exit code 1 where one is not noticed."""
    numbers = [int(word) for word in words] or range(len(MUTATIONS))
    for name in _OTHERS:
        __import__(name)
    with tempfile.TemporaryDirectory() as scratch:
        clone = Path(scratch) / "clone"
        shutil.copytree(PROJECT, clone, ignore=_LEFT_OUT, symlinks=True)
        (Path(scratch) / "shared").symlink_to(PROJECT.parent / "shared")
        return int(sum(not _noticed(number, clone) for number in numbers) > 0)


def _noticed(number: int, clone: Path) -> bool:
    """Whether the tests pass without an error, and one fails with it."""
    mutation = MUTATIONS[number]
    source = clone / mutation.path
    text = source.read_text(encoding="utf-8")
    if text.count(mutation.right) != 1:
        print(f"{number:2} {mutation.what}: {mutation.path} is no longer what it was")
        return False
    passed = _passes(mutation, clone)
    source.write_text(text.replace(mutation.right, mutation.wrong), encoding="utf-8")
    failed = not _passes(mutation, clone)
    source.write_text(text, encoding="utf-8")
    said = "noticed" if passed and failed else "NOT NOTICED" if passed else "its tests fail without it"
    print(f"{number:2} {mutation.what}: {said}", flush=True)
    return passed and failed


def _passes(mutation: Mutation, clone: Path) -> bool:
    """Whether the tests pass, in a process that has what takes long to import already."""
    child = os.fork()
    if child == 0:
        os.chdir(clone)
        sys.path.insert(0, str(clone))
        os.environ["PYTHONPATH"] = str(clone)
        log = os.open(clone / "mutation.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1), os.dup2(log, 2)
        import pytest

        options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-p", "no:randomly"]
        os._exit(int(pytest.main([*options, *mutation.tests])))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
