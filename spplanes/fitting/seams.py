"""Where planes meet: by where its beam meets its own plane, a point may be of another one."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inner, njit
from spplanes._threads import in_parts

#: Standard deviations within which the place where a beam meets one plane may lie on another: of returns of two planes
#: that are further apart, one in forty goes to the wrong one.
APART = 4.0
#: Planes whose normals enclose less than this do not meet in a seam: cosine of 30 deg.
SAME_WAY = 0.866


def at_seams(
    points: FloatArray, covariance: FloatArray, labels: np.ndarray, frames: FloatArray, uneven_m: float = 0.0
) -> np.ndarray:
    """Which points of planes may be of another plane, which looks another way, as well; shape (S, B) bool.

    A point where two planes meet goes to the one it fits better. Those that go over lie, for the plane they come to,
    all on the side where their own is: every wall of a room is fitted too far inside, by L sigma^2 / 2A of an area A
    with edges L long, however many points there are. Which points these are must not depend on their errors: it is
    those whose beam meets their plane where it would meet another one within its noise.

    The place where a beam meets a plane is where its point is moved to by C n (n.x - d) / (n.C n), along the beam where
    its range alone errs. Both planes are uneven: by as much as the first is (`uneven_m`), divided by the sine at which
    the beam meets it, that place moves along the beam. For the other arguments see `spplanes.segmentation`.
    """
    found = np.zeros(labels.shape, dtype=bool)
    if len(frames) < 2:
        return found
    planes, labels = _hesse(frames), np.ascontiguousarray(labels, dtype=np.int64)
    boxes, widest = np.empty((len(frames), 4)), np.zeros(len(frames))
    boxes[:, :2], boxes[:, 2:] = np.inf, -np.inf
    grid = points, covariance, labels
    _enclose(grid, (frames, planes), uneven_m**2, boxes, widest)
    first, others = _neighbours(frames, planes, boxes, APART * np.sqrt(widest))
    if len(others):
        regions = frames, planes, boxes, first, others
        in_parts(lambda a, b: _find_rows(grid, regions, uneven_m**2, a, b, found), len(labels), labels.size)
    return found


def placed(points: FloatArray, covariance: FloatArray, labels: np.ndarray, frames: FloatArray) -> FloatArray:
    """Points as far from their planes as they are, at the places where their beams meet these, shape (S, B, 3), m.
    Noise along a slanted beam takes a point along the plane as well, the farther the farther it lies off: the plane of
    least squares turns by the mean of sigma^2 sin cos over the square of their spread. Arguments as of `at_seams`."""
    moved, grid = points.copy(), (points, covariance, np.ascontiguousarray(labels, dtype=np.int64))
    in_parts(lambda a, b: _move_rows(grid, _hesse(frames), a, b, moved), len(labels), labels.size)
    return moved


def along_beams(points: FloatArray, eyes: FloatArray) -> FloatArray:
    """Covariances of noise of 1 m along the beams from eyes (S, B, 3) or (S, 1, 3) to points (S, B, 3): (S, B, 9).
    There is a hundredth across: what beams that graze a plane read is not their range's noise alone."""
    beams = points - eyes
    beams /= np.maximum(np.linalg.norm(beams, axis=2, keepdims=True), 1e-12)
    return (beams[..., :, None] * beams[..., None, :] + 0.01 * np.eye(3)).reshape(*points.shape[:2], 9)


def _hesse(frames: FloatArray) -> FloatArray:
    """(normal, d) of planes, shape (R, 4)."""
    normals = frames[:, :3, 2]
    return np.column_stack((normals, (normals * frames[:, :3, 3]).sum(axis=1)))


def _neighbours(
    frames: FloatArray, planes: FloatArray, boxes: FloatArray, margins: FloatArray
) -> tuple[np.ndarray, np.ndarray]:
    """Planes that look another way and come near, to margins (R,), m; those of r are others[first[r]:first[r + 1]].
    ``planes`` are (normal, d), ``boxes`` the (x, y) from and to in their frames, (R, 4) both."""
    x, y = boxes[:, [0, 2, 2, 0]], boxes[:, [1, 1, 3, 3]]
    held = np.asarray(np.isfinite(x).all(axis=1))
    x, y = np.where(held[:, None], x, 0.0), np.where(held[:, None], y, 0.0)
    corners = frames[:, None, :3, 3] + x[..., None] * frames[:, None, :3, 0] + y[..., None] * frames[:, None, :3, 1]
    off = np.einsum("rck,sk->rsc", corners, planes[:, :3]) - planes[None, :, 3, None]
    low, high = off.min(axis=2), off.max(axis=2)
    margin = np.sqrt(2.0) * margins[:, None]  # a box that is as much wider along both axes has corners so far off
    reaches = np.maximum(low, low.T) <= margin
    reaches &= np.minimum(high, high.T) >= -margin
    meets = reaches & held & held[:, None] & (np.abs(planes[:, :3] @ planes[:, :3].T) <= SAME_WAY)
    return np.append(0, np.cumsum(meets.sum(axis=1))), np.nonzero(meets)[1]


@njit(cache=True)
def _enclose(grid, regions, uneven, boxes, widest):
    """Boxes of the planes in their frames, and the largest variance of a place on each in any direction, in place."""
    (points, covariance, labels), (frames, planes), toward = grid, regions, np.empty(3)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r < 0:
                continue
            off, variance = _beam_to(points, covariance, i, j, planes[r], toward), uneven
            for axis in range(2):
                at = _place_along(points, i, j, off, toward, frames[r], axis)
                boxes[r, axis] = min(boxes[r, axis], at)
                boxes[r, axis + 2] = max(boxes[r, axis + 2], at)
            for k in range(3):
                variance += uneven * toward[k] * toward[k]
            widest[r] = max(widest[r], variance + _trace(covariance, i, j))


@inner(cache=True)
def _trace(covariance, i, j):
    if covariance.shape[2] == 1:
        return 3.0 * covariance[i, j, 0]
    return covariance[i, j, 0] + covariance[i, j, 4] + covariance[i, j, 8]


@njit(cache=True)
def _find_rows(grid, regions, uneven, begin, end, found):
    """Set `found` for the points, in some rows, whose place on their plane may be on another one."""
    (points, covariance, labels), (frames, planes, boxes, first, others), toward = grid, regions, np.empty(3)
    for i in range(begin, end):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r < 0 or first[r] == first[r + 1]:
                continue
            off, trace = _beam_to(points, covariance, i, j, planes[r], toward), _trace(covariance, i, j)
            for m in range(first[r], first[r + 1]):
                q = others[m]
                apart, ratio = -planes[q, 3], 0.0
                for k in range(3):
                    apart += planes[q, k] * points[i, j, k]
                    ratio += planes[q, k] * toward[k]
                apart -= ratio * off
                variance = uneven * (1.0 + ratio * ratio)
                if apart * apart > APART * APART * (variance + trace):  # no noise along a direction exceeds the trace
                    continue
                if covariance.shape[2] == 1:
                    variance += covariance[i, j, 0]
                else:
                    for k in range(9):
                        variance += planes[q, k // 3] * covariance[i, j, k] * planes[q, k % 3]
                if apart * apart > APART * APART * variance:
                    continue
                reach, inside = APART * np.sqrt(variance), True
                for axis in range(2):
                    at = _place_along(points, i, j, off, toward, frames[q], axis)
                    inside &= boxes[q, axis] - reach <= at <= boxes[q, axis + 2] + reach
                if inside:
                    found[i, j] = True
                    break


@njit(cache=True)
def _move_rows(grid, planes, begin, end, moved):
    """Move points along their plane to where their beams meet it, in some rows, in place."""
    (points, covariance, labels), toward = grid, np.empty(3)
    for i in range(begin, end):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                off = _beam_to(points, covariance, i, j, planes[r], toward)
                for k in range(3):
                    moved[i, j, k] -= off * (toward[k] - planes[r, k])


@inner(cache=True)
def _beam_to(points, covariance, i, j, plane, toward):
    """Distance of a point from a plane (normal, d), and C n / (n.C n), (3,): what takes it there for each metre."""
    off, own = -plane[3], 0.0
    for k in range(3):
        off += plane[k] * points[i, j, k]
        toward[k] = plane[k]
        if covariance.shape[2] == 9:
            toward[k] = 0.0
            for m in range(3):
                toward[k] += covariance[i, j, 3 * k + m] * plane[m]
        own += plane[k] * toward[k]
    own = max(own, 1e-12)
    for k in range(3):
        toward[k] /= own
    return off


@inner(cache=True)
def _place_along(points, i, j, off, toward, frame, axis):
    """Where a beam meets its plane, see `_beam_to`, along an axis of a frame (4, 4), m."""
    at = 0.0
    for k in range(3):
        at += frame[k, axis] * (points[i, j, k] - off * toward[k] - frame[k, 3])
    return at
