"""Factors of one plane seen from one pose, whatever their type: what a g2o edge can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np

from factors._custom import describe
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class SinglePlaneFactor:
    """A factor that depends on one plane, seen from one pose."""

    plane_key: int
    pose_key: int | None
    """None: seen from the frame that the landmark lives in, or from the world."""
    factor: Any
    """Its poses do not matter: it is evaluated with all of them at the origin."""
    in_world: bool = False
    """Without a pose: it speaks of the landmark in the world, though that lives in the frame of an anchor."""


def single_plane_factor(factor: Any) -> SinglePlaneFactor | None:
    """The factor as a sighting of one plane; None where it is none."""
    if isinstance(factor, gtsam.CustomFactor):
        recipe = describe(factor)
        if recipe is None or recipe.reference_key is not None or recipe.planar:
            return None
        in_world = recipe.pose_key is None and recipe.anchor_key is not None
        return SinglePlaneFactor(recipe.plane_key, recipe.pose_key, factor, in_world)
    keys = list(factor.keys())
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor | gtsam.OrientedPlane3Factor):
        return SinglePlaneFactor(keys[-1], keys[0], factor)
    if isinstance(factor, gtsam.OrientedPlane3DirectionPrior):
        return SinglePlaneFactor(keys[0], None, factor)
    return None


def linearised(factor: Any, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
    """Whitened Jacobian (m, n) and negative whitened error (m,) of a factor, without the weight of a robust kernel."""
    matrix, rest = factor.linearize(values).jacobian()
    if not isinstance(factor.noiseModel(), gtsam.noiseModel.Robust):
        return matrix, rest
    weighted, bare = np.linalg.norm(rest), np.linalg.norm(gaussian_of(factor).whiten(factor.unwhitenedError(values)))
    scale = bare / weighted if weighted > 0.0 else 1.0
    return scale * matrix, scale * rest


def gaussian_of(factor: Any) -> Any:
    """The noise model of a factor, without a robust kernel."""
    noise = factor.noiseModel()
    return noise.noise() if isinstance(noise, gtsam.noiseModel.Robust) else noise
