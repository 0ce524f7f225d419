"""Fusion: landmarks that are one plane become one inside iSAM2, and two again when that turns out to be wrong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, Literal

import gtsam
import numpy as np
from scipy.special import chdtri

from factors import plane_factor, plane_landmark
from factors.association.estimate import observation_factor
from factors.association.observations import Observation
from slam.backend.estimator import BackendError, pose_symbol
from slam.config import BOUND_SIGMAS
from slam.geometry.frames import inverse
from slam.map.landmarks import Landmark, Sighting
from slam.map.state import EstimatorState
from slam.mapping.same_plane import same_plane_chi2
from spplanes.outlines.extents import Extent

Cause = Literal["same plane", "loop"]


@dataclass(eq=False)
class Merge:
    """Two landmarks that were taken for one."""

    keyframe: int
    """When: index of the keyframe."""
    older: int
    """Id of the landmark that took everything."""
    younger: int
    """Id of the one that is gone."""
    cause: Cause
    """same plane: their difference passed its chi2; loop: a closure paired them."""
    gone: Landmark
    """The younger as it was."""
    undone: int | None = None
    """The keyframe at which the merge was found wrong; None: it stands."""
    next_look: int = 0
    """Keyframe from which on its residuals are looked at again."""


#: After an undone merge the estimate goes back a long way: so often iSAM2 relinearises.
_ROUNDS = 5


class Merges:
    """Every merge of a run, and the landmarks that must never be merged again."""

    def __init__(self, state: EstimatorState) -> None:
        self.history: list[Merge] = []
        self._keyframes, self._landmarks = state.keyframes, state.landmarks
        self._backend, self._config = state.backend, state.config
        self._apart: set[frozenset[int]] = set()
        self._bent_m = 0.0

    def may_be_one(self, first: int, second: int) -> bool:
        """Whether two landmarks were never found to be two after all."""
        return first != second and frozenset((first, second)) not in self._apart

    def merge(self, older: int, younger: int, cause: Cause) -> Merge:
        """Give a landmark everything that was seen of another one; its factors are re-keyed, its variable goes."""
        factors, old = self._rekeyed(older, younger, cause)
        indices = self._backend.update(factors, gtsam.Values(), remove=old, relinearize=True)
        return self._joined([(older, younger)], [indices], cause)[0]

    def close(self, pairs: Sequence[tuple[int, int]], scale: float) -> bool:
        """Merge the pairs of a loop closure, no landmark in two of them, unless the graph as a whole is against it.

        What a true closure adds to the chi2 of the graph is chi2 with 3 degrees of freedom a pair. All pairs are tried
        at once; a graph that refuses them is as it was before, and they are never merged again. `scale` as in
        `doubted`.
        """
        before, undisturbed = self._backend.chi2(), self._backend.snapshot()
        limit = float(chdtri(max(3 * len(pairs), 1), self._config.association.new_significance))
        parts = [self._rekeyed(older, younger, "loop") for older, younger in pairs]
        factors, old = ([one for part in parts for one in part[side]] for side in (0, 1))
        try:
            indices = self._backend.exchange(factors, old, [self._landmarks[younger].key for _, younger in pairs])
            fits = self._backend.settles_below(before + max(scale, 1.0) * limit, _ROUNDS)
        except BackendError:
            indices, fits = [], False
        if fits:
            ends = np.cumsum([0, *(len(mine) for mine, _ in parts)]).tolist()
            self._joined(pairs, [indices[start:end] for start, end in pairwise(ends)], "loop")
        else:
            self._backend.restore(undisturbed)
            self._apart.update(frozenset(pair) for pair in pairs)
        return fits

    def reconsider(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Let landmarks that a closure found to be two be compared again: the estimate is another one now."""
        self._apart.difference_update(frozenset(pair) for pair in pairs)

    def _rekeyed(self, older: int, younger: int, cause: Cause) -> tuple[list[Any], list[int]]:
        """Factors of what was seen of the younger, now of the older, and the indices of those they replace."""
        gone, home = self._landmarks[younger], self._landmarks[older]
        otherwise = self._config.backend.robust_loops if cause == "loop" else None
        factors = [self._factor(one, home, one.robust or otherwise) for one in gone.sightings]
        return factors, [one.factor_index for one in gone.sightings]

    def _joined(
        self, pairs: Sequence[tuple[int, int]], factor_indices: Sequence[Sequence[int]], cause: Cause
    ) -> list[Merge]:
        """Let landmarks know that everything seen of others is of them: the graph holds it so, by these factors."""
        now, removed = len(self._keyframes) - 1, [self._landmarks.remove(younger) for _, younger in pairs]
        self._landmarks.refresh(self._backend)
        merges = []
        for (older, _), gone, indices in zip(pairs, removed, factor_indices, strict=True):
            home, home_T_world = self._landmarks[older], inverse(self._landmarks.placed(older).world_T_plane)
            home.seen_by_past = sorted({*home.seen_by_past, *gone.seen_by_past})
            for sighting, index in zip(gone.sightings, indices, strict=True):
                plane_T_body = home_T_world @ self._backend.pose(pose_symbol(sighting.keyframe))
                self._landmarks.see(
                    home, self._observation(sighting), replace(sighting, factor_index=index), plane_T_body
                )
            merges.append(Merge(now, older, gone.id, cause, gone, next_look=now + 1))
        self._landmarks.refresh(self._backend)
        self.history += merges
        return merges

    def undo(self, merge: Merge) -> None:
        """Take a merge back: the younger returns with its own factors and those of later sightings that fit it better.

        The older may itself have been merged since: the sightings are taken from wherever they are now.
        """
        now, holder = len(self._keyframes) - 1, self._holder(merge)
        taken = self._taken(merge, holder)
        back = replace(merge.gone, sightings=[], n_points=0)
        holder.seen_by_past = sorted({*holder.seen_by_past}.difference(back.seen_by_past))
        self._landmarks.plant(back)
        # that of a prior map has stayed: what its planes share is one factor
        self._move(taken, holder, back, initial=not self._backend.has_plane(back.key))
        later = [sighting for sighting in holder.sightings if sighting.keyframe > merge.keyframe]
        self._move([one for one in later if self._misfit(one, back) < self._misfit(one, holder)], holder, back)
        self._backend.settle(_ROUNDS)
        self._landmarks.refresh(self._backend)
        self._regrow(holder)
        self._regrow(back)
        self._landmarks.refresh(self._backend)
        self._apart.add(frozenset((holder.id, back.id)))
        merge.undone = now

    def bent(self, by_m: float) -> None:
        """Poses of the whole way went by so much at most: once that adds up to more than passes for tied, draw anew."""
        self._bent_m += by_m
        if self._bent_m > self._config.loops.tied_m / BOUND_SIGMAS:
            self._bent_m = 0.0
            self.redraw(0)

    def redraw(self, since: int) -> None:
        """Draw anew what was seen of the landmarks that a keyframe from `since` on saw: the poses were wrong."""
        now = len(self._keyframes) - 1
        for landmark in self._landmarks:
            if landmark.was_seen_between(since, now):
                self._regrow(landmark)
        self._landmarks.refresh(self._backend)

    def doubted(self, touched: Iterable[int], scale: float) -> list[Merge]:
        """Merges of the landmarks at hand whose re-keyed measurements no longer fit, worst first.

        Args:
            touched: ids of landmarks that were seen, or that something was compared with.
            scale: mean NIS per degree of freedom of the run, 1 if its covariances are honest: misfit that every
                measurement has is no sign of a wrong merge.
        """
        now, seen = len(self._keyframes) - 1, set(touched)
        found = []
        for merge in self.history:
            if merge.undone is not None or merge.next_look > now:
                continue
            holder = self._holder(merge)
            if now > merge.keyframe + 10 and holder.id not in seen:
                continue  # before that seen or not: what bends the way is seen no more
            merge.next_look = now + max(2 * (now - merge.keyframe), 1)
            taken = self._taken(merge, holder)[:30]  # more say no more
            if not taken:  # all of it was seen from keyframes that have left the graph
                continue
            misfit = sum(self._misfit(one, holder) for one in taken)
            dof = sum(3 if one.kind == "plane" else 2 for one in taken)
            limit = float(chdtri(dof, self._config.association.new_significance))
            if misfit > max(scale, 1.0) * limit:
                found.append((misfit / limit, merge))
        return [merge for _, merge in sorted(found, key=lambda one: (-one[0], one[1].keyframe, one[1].younger))]

    def split_if_two(self, merge: Merge) -> None:
        """Undo a doubted merge, and merge again if the two, each by its own measurements, still pass for one."""
        holder = self._holder(merge)
        self.undo(merge)
        back = self._landmarks[merge.younger]
        limit = float(chdtri(3, self._config.association.new_significance))
        if same_plane_chi2(holder, back, self._backend) <= limit:
            self._apart.discard(frozenset((holder.id, back.id)))
            self.merge(holder.id, back.id, merge.cause).next_look = merge.next_look

    def _holder(self, merge: Merge) -> Landmark:
        """The landmark that has the sightings of a merged one now."""
        key = merge.older
        while key not in self._landmarks:
            key = next(one.older for one in reversed(self.history) if one.younger == key and one.undone is None)
        return self._landmarks[key]

    def _taken(self, merge: Merge, holder: Landmark) -> list[Sighting]:
        """The sightings of the merged landmark that its holder has."""
        mine = {(sighting.keyframe, sighting.observation) for sighting in merge.gone.sightings}
        return [sighting for sighting in holder.sightings if (sighting.keyframe, sighting.observation) in mine]

    def _observation(self, sighting: Sighting) -> Observation:
        return self._keyframes[sighting.keyframe].observations[sighting.observation]

    def _factor(self, sighting: Sighting, landmark: Landmark, robust: str | None = None) -> Any:
        pose_key = pose_symbol(sighting.keyframe)
        return observation_factor(self._observation(sighting), pose_key, landmark, self._backend, robust)

    def _misfit(self, sighting: Sighting, landmark: Landmark) -> float:
        """Chi2 of a sighting if it is of a landmark."""
        factor = self._factor(sighting, landmark)
        return 2.0 * float(factor.error(self._backend.values_of(factor.keys())))

    def _move(
        self, sightings: Sequence[Sighting], source: Landmark, target: Landmark, *, initial: bool = False
    ) -> None:
        """Re-key sightings from one landmark to another; `initial`: with them its variable comes into the graph."""
        if not sightings:
            return
        values, factors, rest = gtsam.Values(), [], list(sightings)
        estimate: Any = self._backend
        if initial:
            factors.append(self._founding_factor(rest.pop(0), target, values))
            estimate = SimpleNamespace(pose=self._backend.pose, plane=values.atOrientedPlane3)
        for one in rest:
            seen, pose_key = self._observation(one), pose_symbol(one.keyframe)
            factors.append(observation_factor(seen, pose_key, target, estimate, one.robust))
        old = [one.factor_index for one in sightings]
        indices = self._backend.update(factors, values, remove=old, relinearize=True)
        moved = {(one.keyframe, one.observation) for one in sightings}
        points = sum(self._observation(one).n_points for one in sightings)
        source.n_points, target.n_points = source.n_points - points, target.n_points + points
        source.sightings = [one for one in source.sightings if (one.keyframe, one.observation) not in moved]
        anew = [replace(one, factor_index=i) for one, i in zip(sightings, indices, strict=True)]
        target.sightings = target.sightings + anew  # another list: what counts them looks at which one it is

    def _founding_factor(self, sighting: Sighting, landmark: Landmark, values: gtsam.Values) -> gtsam.NonlinearFactor:
        """The factor that a landmark starts with: of full rank, what a line leaves open closed by the rule's tilt."""
        plane = self._observation(sighting).full_plane(self._config.landmarks.wall_tilt_sigma_rad)
        pose_key = pose_symbol(sighting.keyframe)
        anchor_T_body = inverse(self._backend.pose(landmark.anchor_key)) @ self._backend.pose(pose_key)
        values.insert(landmark.key, plane_landmark(plane.transform(anchor_T_body)))
        return plane_factor(plane, pose_key, landmark.key, anchor_key=landmark.anchor_key)

    def _regrow(self, landmark: Landmark) -> None:
        """What was seen of a landmark, from its sightings alone."""
        plane_T_world = inverse(self._landmarks.placed(landmark.id).world_T_plane)
        landmark.sightings.sort(key=lambda one: (one.keyframe, one.observation))
        landmark.extent = Extent(landmark.first_outline)
        for sighting in landmark.sightings:
            plane_T_body = plane_T_world @ self._backend.pose(pose_symbol(sighting.keyframe))
            landmark.extent.grow(self._observation(sighting).patch_in(plane_T_body))
