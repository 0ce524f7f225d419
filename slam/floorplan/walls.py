"""Wall solids: two faces back to back, as far as both were seen, and how far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam.floorplan.faces import ALIKE_RAD, Face, Interval, shared
from slam.floorplan.joint_planes import JointPlanes
from slam.floorplan.quantities import Quantity, Section, distance
from slam.floorplan.rooms import BUILT_RAD, THICKEST_M
from spplanes._check import FloatArray

#: Two faces are of one wall unless chi2 of their angle says so at this level.
_SIGNIFICANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Wall:
    """A piece of wall between two faces."""

    front: Face
    """The face it is described along."""
    back: Face
    """The face that looks the other way."""
    span: Interval
    """From where to where along the front, m."""
    thickness: Quantity
    """In the middle of the span, m."""

    @property
    def outline(self) -> FloatArray:
        """Its corners in the section, anticlockwise seen from above, shape (4, 3), m."""
        ends = np.array([self.front.point(s) for s in self.span])
        behind = [self.back.point(float(self.back.s_of(end))) for end in ends]
        return np.array([*ends[::-1], *behind])


def wall_solids(joint: JointPlanes, section: Section, extents: Sequence[tuple[Face, list[Interval]]]) -> list[Wall]:
    """Faces of a storey paired to walls, each stretch with the nearest face behind it.

    Args:
        joint: all planes.
        section: of the storey.
        extents: the faces, and from where to where each goes.
    """
    found: list[Wall] = []
    for number, (front, spans) in enumerate(extents):
        left = spans
        for other in _behind(joint, section, front, [face for face, _ in extents]):
            back, others = extents[other]
            common = shared(left, [front.beside(back, span) for span in others])
            left = without(left, common)
            if other > number:
                found += [Wall(front, back, span, _at(joint, front, back, span)) for span in common]
    return found


def _behind(joint: JointPlanes, section: Section, front: Face, faces: Sequence[Face]) -> list[int]:
    """Which faces may be the other side of the wall behind one, the nearest first."""
    thick = [(_thickness(joint, section, front, back), k) for k, back in enumerate(faces) if back is not front]
    return [k for _, k in sorted((one.value, k) for one, k in thick if one is not None)]


def _thickness(joint: JointPlanes, section: Section, front: Face, back: Face) -> Quantity | None:
    """Distance of two faces that may be of one wall, somewhere; None if they are not."""
    if front.normal @ back.normal > -np.cos(ALIKE_RAD):
        return None
    low, high = front.covered[0][0], front.covered[-1][1]
    thickness = _at(joint, front, back, (low, high))
    if not 0.0 < thickness.value <= THICKEST_M or not _are_parallel(joint, section, front, back):
        return None
    return thickness


def _at(joint: JointPlanes, front: Face, back: Face, span: Interval) -> Quantity:
    direction = (back.normal - front.normal) / np.linalg.norm(back.normal - front.normal)
    place = front.point(0.5 * (span[0] + span[1]))
    return joint.quantity(*distance(joint.hesse, front.plane, back.plane, place, direction))


def _are_parallel(joint: JointPlanes, section: Section, front: Face, back: Face) -> bool:
    """Whether the angle between two faces in the plan is one that noise and building explain, by chi2 of 1 dof."""
    angle = joint.quantity(*plan_angle(joint, section, front, back))
    chi2 = angle.value**2 / (angle.sigma**2 + BUILT_RAD**2)
    return bool(chi2 <= chi2_distribution.isf(_SIGNIFICANCE, 1))


def plan_angle(joint: JointPlanes, section: Section, front: Face, back: Face) -> tuple[float, dict[int, FloatArray]]:
    """By how much two faces are off from back to back in the plan, small angles, rad, and its derivatives."""
    first, second = joint.hesse[front.plane, :3], joint.hesse[back.plane, :3]
    gradient = {
        front.plane: np.append(np.cross(second, section.normal), 0.0),
        back.plane: np.append(np.cross(section.normal, first), 0.0),
    }
    return float(np.cross(first, second) @ section.normal), gradient


def without(spans: list[Interval], taken: list[Interval]) -> list[Interval]:
    """Intervals less others."""
    for low, high in taken:
        pieces = [piece for a, b in spans for piece in ((a, min(b, low)), (max(a, high), b))]
        spans = [(a, b) for a, b in pieces if b > a]
    return spans
