"""Observability and degeneracy: which motions of a keyframe what was seen does not fix, by name and size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from factors.association.observations import Observation
from slam.backend.estimator import Backend, pose_symbol
from slam.config import ObservabilityConfig
from slam.frontend.information import floor_information, plane_information
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.lazy import Rows
from slam.map.data_association import Decision
from slam.map.landmarks import LandmarkMap
from slam.tracking.prediction import Prediction
from spplanes._check import FloatArray

Part = Literal["position", "orientation"]

#: Keeps the information matrices invertible: the pose is known to a kilometre and to 30 rad anyway.
NOTHING = np.diag([1e-3] * 3 + [1e-6] * 3)


@dataclass(frozen=True, eq=False)
class OpenDirection:
    """A direction of a keyframe's motion that the planes it was matched to leave open."""

    keyframe: int
    """Index of the keyframe."""
    part: Part
    """position: along the direction; orientation: about it."""
    direction: FloatArray
    """Unit vector in the world, shape (3,), its largest component positive."""
    sigma_seen: float
    """Standard deviation that the planes alone, taken as known, leave there, m or rad; inf where they say nothing."""

    @property
    def name(self) -> str:
        """Such as "along x" or "about z"."""
        return name_of(self.part, self.direction)


@dataclass(frozen=True, eq=False)
class OpenStretch:
    """The same direction left open over a run, or in the map as a whole against its first keyframe, by planes alone."""

    part: Part
    """position or orientation."""
    direction: FloatArray
    """Mean direction in the world, shape (3,)."""
    keyframes: tuple[int, ...]
    """The keyframes that leave it open, ascending."""
    total: int
    """Keyframes that could have fixed it: all of the run but the first, or those of the map that were looked at."""
    sigma: float
    """Standard deviation there of the last of these keyframes in the whole graph, everything known; in the map the
    largest by the planes alone, inf where they say nothing: m or rad."""
    source: str | None = None
    """What alone moves the estimate there: odometry, laser odometry, or the assumption of constant velocity; None: of
    the map as a whole."""

    @property
    def sentence(self) -> str:
        """One sentence for the screen."""
        size, unit = (self.sigma, "m") if self.part == "position" else (np.rad2deg(self.sigma), "deg")
        name, count = name_of(self.part, self.direction), f"{len(self.keyframes)} of {self.total} keyframes"
        if self.source is None:
            much = "without bound" if np.isinf(size) else f"by {size:.2g} {unit} (sigma)"
            return f"the map as a whole, {name}: planes alone leave {count} open against the first, {much}"
        number = f"{size:.2g}" if size < 100.0 else f"{size:.0f}"
        at_last = f"sigma {number} {unit} at keyframe {self.keyframes[-1]}"
        return f"{name}: information only from {self.source} at {count}, {at_last}"

    def to_dict(self) -> dict[str, object]:
        """For metrics.json."""
        of_map = self.source is None
        return {
            "part": self.part,
            "direction": [float(x) for x in self.direction],
            "keyframes": list(self.keyframes),
            "looked_at" if of_map else "of": self.total,
            "sigma": float(self.sigma) if np.isfinite(self.sigma) else None,
            "unit": "m" if self.part == "position" else "rad",
            **({} if of_map else {"source": self.source}),
            "sentence": self.sentence,
        }


def open_directions(
    keyframe: int,
    matched: Iterable[Observation],
    world_T_body: FloatArray,
    rules: ObservabilityConfig,
    motion: Motion | None = None,
    normals: Sequence[FloatArray] | None = None,
) -> list[OpenDirection]:
    """Directions of position and orientation that the matched planes of a keyframe leave open, widest first.

    Of each part, with the other marginalised out: the eigenvectors of its covariance whose standard deviation exceeds
    the rule's. The planes are taken as known and odometry as silent: what is open here nothing that was seen fixes. Of
    a body that drives on a floor (`motion`) the floor holds height, roll and pitch, as closely as its noise says.
    `normals` are those of the landmarks they were matched to, in the world, (3,) each: two noisy looks at one wall, or
    at the two sides of a corridor, fix nothing along it.
    """
    planes, world_R = list(matched), world_T_body[:3, :3]
    in_body = [None] * len(planes) if normals is None else [world_R.T @ normal for normal in normals]
    seen = (plane_information(plane, normal) for plane, normal in zip(planes, in_body, strict=True))
    information = sum(seen, start=NOTHING + floor_information(motion))
    return wide_directions(keyframe, np.asarray(np.linalg.inv(information), float), world_R, rules)


def wide_directions(
    keyframe: int, covariance: FloatArray, world_R: FloatArray, rules: ObservabilityConfig
) -> list[OpenDirection]:
    """Directions of position and orientation in which a keyframe's covariance (6, 6) is wide.

    It is of (rotation, translation), along axes that `world_R` (3, 3) turns to those of the world.
    """
    found: list[OpenDirection] = []
    parts: tuple[tuple[Part, slice, float, float], ...] = (
        ("position", slice(3, 6), rules.max_sigma_m, 100.0),
        ("orientation", slice(0, 3), rules.max_sigma_rad, 3.0),
    )
    for part, block, limit, silence in parts:
        variances, vectors = np.linalg.eigh(covariance[block, block])
        sigmas, in_world = np.sqrt(np.maximum(variances[::-1], 0.0)), world_R @ vectors[:, ::-1]
        silent, told = sigmas > silence, (sigmas > limit) & (sigmas <= silence)
        open_ones = [(direction, np.inf) for direction in _along_axes(in_world[:, silent])]
        open_ones += list(zip(in_world[:, told].T, sigmas[told].tolist(), strict=True))
        found += [OpenDirection(keyframe, part, _upright(direction), sigma) for direction, sigma in open_ones]
    return found


def _along_axes(span: FloatArray) -> list[FloatArray]:
    """Directions that span the same space (3, K), each as near to an axis of the world as may be: these have names.

    Where nothing at all is known of two directions, eigenvectors are any two between them.
    """
    found = []
    while span.shape[1]:
        nearest = span @ span[np.linalg.norm(span, axis=1).argmax()]
        found.append(nearest / np.linalg.norm(nearest))
        span = span @ np.linalg.svd((found[-1] @ span)[None])[2][1:].T
    return found


@dataclass
class Observability:
    """What the keyframes of a run left open."""

    rules: ObservabilityConfig
    """From which standard deviation on a direction is open."""
    _rows: Rows = field(default_factory=partial(Rows, "ibdddd"), repr=False)

    @property
    def history(self) -> list[OpenDirection]:
        """Open directions of all keyframes, one after another, made anew of the numbers that they are kept as."""
        return [
            OpenDirection(keyframe, "position" if is_position else "orientation", np.array(direction), sigma)
            for keyframe, is_position, sigma, *direction in self._rows
        ]

    def add(
        self,
        seen: Sequence[Observation],
        prediction: Prediction,
        decisions: Iterable[Decision],
        landmarks: LandmarkMap,
        backend: Backend,
    ) -> None:
        """Look at a keyframe before the graph does, as `open_directions`; the first has nothing to be fixed by."""
        if prediction.index:
            pairs = [(seen[one.observation], one.match.landmark) for one in decisions if one.match is not None]
            normals = [landmarks.placed(landmark).normal for _, landmark in pairs]
            matched, pose = [one for one, _ in pairs], backend.pose(prediction.pose_key)
            for one in open_directions(prediction.index, matched, pose, self.rules, prediction.motion, normals):
                self._rows.append((one.keyframe, one.part == "position", one.sigma_seen, *one.direction.tolist()))

    def stretches(self, keyframes: Sequence[Keyframe], backend: Backend) -> list[OpenStretch]:
        """Directions that what was seen left open, most frequent first, with what is known of them by all means."""
        stretches = []
        for group in gathered(self.history):
            part, last = group[0].part, group[-1].keyframe
            signs = (1.0 if one.direction @ group[0].direction > 0.0 else -1.0 for one in group)
            mean = _upright(np.sum([sign * one.direction for sign, one in zip(signs, group, strict=True)], axis=0))
            sigma, source = sigma_along(part, mean, last, backend), _source_of(keyframes[last].motion)
            opened = tuple(sorted({one.keyframe for one in group}))
            stretches.append(OpenStretch(part, mean, opened, len(keyframes) - 1, sigma, source))
        return stretches


def _source_of(motion: Motion | None) -> str:
    """What a motion comes from: matched scans where those stand in for wheels."""
    if motion is None:
        return "the assumption of constant velocity"
    return "laser odometry" if motion.is_by_returns else "odometry"


def gathered(directions: Iterable[OpenDirection]) -> list[list[OpenDirection]]:
    """Directions that are the same, up to 25 deg, in groups, those of most keyframes first."""
    groups: list[list[OpenDirection]] = []
    for one in directions:
        for group in groups:
            if group[0].part == one.part and abs(float(group[0].direction @ one.direction)) >= 0.9:
                group.append(one)
                break
        else:
            groups.append([one])
    return sorted(groups, key=lambda group: -len({one.keyframe for one in group}))


def name_of(part: Part, direction: FloatArray) -> str:
    """Name of a direction in the world: along or about an axis, up to 10 deg, or the vector itself."""
    word = "along" if part == "position" else "about"
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) >= 0.985:
        return f"{word} {'xyz'[axis]}"
    return f"{word} ({', '.join(f'{x:.2f}' for x in direction)})"


def sigma_along(part: Part, direction: FloatArray, keyframe: int, backend: Backend) -> float:
    """Standard deviation, m or rad, of a keyframe's pose along or about a direction of the world (3,), by the graph."""
    key, block = pose_symbol(keyframe), slice(3, 6) if part == "position" else slice(0, 3)
    covariance = backend.read_covariance(key)
    in_body = backend.pose(key)[:3, :3].T @ direction
    return float(np.sqrt(max(in_body @ covariance[block, block] @ in_body, 0.0)))


def _upright(vector: FloatArray) -> FloatArray:
    """The unit vector of a direction without a sense: its largest component positive."""
    unit = vector / np.linalg.norm(vector)
    return unit if unit[np.argmax(np.abs(unit))] > 0.0 else -unit
