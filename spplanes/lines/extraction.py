"""Line extraction from one scan of a 2D laser, with the covariance of every line."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_float_array, as_number, as_positive, as_shape, check_instance
from spplanes.line import ScanLine
from spplanes.lines._extract import extract
from spplanes.lines._shared_error import with_shared_error

#: Two turns, rad: no convention writes a bearing beyond, and any scan in degrees does.
_LARGEST_BEARING = 4.0 * np.pi


@dataclass(frozen=True)
class LineConfig:
    """What counts as a line. Nothing here is a distance to be tuned to a room: the noise model decides."""

    significance: float = 1e-3
    """Error probability of the chi2 tests that split, merge, break and trim, in (0, 0.5)."""
    min_points: int = 6
    """Fewest beams on a line, >= 3."""
    max_missing: int = 3
    """Consecutive beams that may be missing, or pass through, inside a line without evidence on both sides, >= 0."""
    max_turning: float = 1.0
    """A line is reported when its beams rule out (3 sigma) an arc that turns by this angle, rad, in (0, pi)."""
    max_nonlinearity: float = 0.25
    """A line is reported when (alpha, rho) is Gaussian: the second-order change of rho with alpha, rho var(alpha) / 2,
    is below this share of the standard deviation of the line's shift, > 0. Short lines far away fail."""
    max_misfit: float = 4.0
    """Largest chi2 per degree of freedom of a line, > 1; above 1 it allows for walls that are not quite straight."""
    bearing_sigma: float = 0.0
    """Standard deviation of a bearing, rad, >= 0; it weighs where a beam grazes a wall."""
    flatness: float = 0.0
    """How straight real walls are, rms, m, >= 0: every beam of a wall shares it, so no number of beams averages it out.
    It goes into the tests that join pieces and into the covariance: into the shift, and by sqrt(12) / length into the
    direction. Walls of offices, measured on two logs: 2 mm."""
    range_min: float = 0.0
    """Ranges up to this are no return, m, >= 0."""
    range_max: float = float("inf")
    """Ranges from this on are no return, m, > range_min."""

    def __post_init__(self) -> None:
        for field in fields(self):
            as_number(field.name, getattr(self, field.name), finite=False)
        _check("bearing_sigma", self.bearing_sigma, 0.0 <= self.bearing_sigma < np.pi, "an angle >= 0")
        _check("flatness", self.flatness, 0.0 <= self.flatness < np.inf, "a distance >= 0")
        _check("significance", self.significance, 0.0 < self.significance < 0.5, "a probability in (0, 0.5)")
        _check("min_points", self.min_points, _is_count(self.min_points, 3), "a whole number of beams >= 3")
        _check("max_missing", self.max_missing, _is_count(self.max_missing, 0), "a whole number of beams >= 0")
        _check("max_turning", self.max_turning, 0.0 < self.max_turning < np.pi, "an angle in (0, pi)")
        _check("max_nonlinearity", self.max_nonlinearity, self.max_nonlinearity > 0.0, "a ratio above 0")
        _check("max_misfit", self.max_misfit, self.max_misfit > 1.0, "a ratio above 1")
        _check("range_min", self.range_min, 0.0 <= self.range_min < np.inf, "a finite range >= 0")
        _check("range_max", self.range_max, self.range_max > self.range_min, "a range above range_min")


def _is_count(value: object, smallest: int) -> bool:
    return isinstance(value, int | np.integer) and int(value) >= smallest


def _check(name: str, value: float, valid: bool, expected: str) -> None:
    if not valid:
        raise ValueError(f"{name}: expected {expected}, got {value}")


def extract_lines(
    ranges: ArrayLike,
    angles: ArrayLike,
    *,
    sigma: ArrayLike,
    config: LineConfig | None = None,
    shared_error: bool = True,
) -> list[ScanLine]:
    """Extract the straight lines of one 2D scan.

    Args:
        ranges: shape (B,), m; NaN, infinity, 0 and below, and anything outside (range_min, range_max) is no return.
        angles: bearings in the scan plane (x forward, y left), shape (B,), rad, in any order and spacing; any field
            of view up to a full turn, which is treated as closed.
        sigma: standard deviation of the range, m, one number or shape (B,). The bearing's is in `config`.
        config: what counts as a line.
        shared_error: look in the residuals of all lines for more noise than is stated, and for errors that beams side
            by side on a wall share, and count both in the covariances (see `spplanes.fitting.shared_error`); what is
            stated is a lower bound. Which beams are a line, and where it is, does not depend on it.

    Returns:
        The lines in order of bearing, deterministic; chi2 is by the stated noise.

    Raises:
        ValueError: shapes that differ, angles in degrees, angles or sigma that are not finite, sigma not positive.
    """
    config = LineConfig() if config is None else config
    check_instance("config", config, LineConfig)
    ranges = as_shape("ranges", ranges, (None,), finite=False)
    angles = as_shape("angles", angles, ranges.shape)
    if angles.size and (largest := float(np.abs(angles).max())) > _LARGEST_BEARING:
        raise ValueError(f"angles: expected bearings in radians, got {largest:.6g}, as if in degrees")
    sigmas = _as_sigmas(sigma, ranges.size)
    if ranges.size < 3:
        return []
    rows, support, counts = extract(
        _writable(ranges), _writable(angles), _writable(sigmas),
        config.bearing_sigma, config.flatness, config.range_min, config.range_max,
        config.max_missing, config.significance, config.min_points, config.max_turning, config.max_nonlinearity,
        config.max_misfit,
    )  # fmt: skip
    if shared_error and len(rows):
        found = with_shared_error(rows, support, counts, ranges, angles, sigmas, config.bearing_sigma, config.flatness)
        rows[:, 4:8] = found.reshape(-1, 4)
    ends = np.cumsum(counts)
    blocks = rows[:, 4:].reshape(-1, 2, 2, 2)
    return [
        ScanLine._trusted(alpha, rho, block[0], block[1], support[end - count : end], chi2, int(dof))
        for (alpha, rho, chi2, dof), block, count, end in zip(rows[:, :4].tolist(), blocks, counts, ends, strict=True)
    ]


def _as_sigmas(sigma: ArrayLike, n: int) -> FloatArray:
    """Standard deviation per beam, shape (n,)."""
    if np.ndim(sigma) == 0:
        return np.full(n, as_positive("sigma", as_float_array("sigma", sigma).item()))
    sigmas = as_shape("sigma", sigma, (n,))
    if n and sigmas.min() <= 0.0:
        raise ValueError(f"sigma: expected positive standard deviations, got {sigmas.min()}")
    return sigmas


def _writable(array: FloatArray) -> FloatArray:
    """The array itself, or a copy of a read-only one, for which numba would compile everything anew."""
    return array if array.flags.writeable else array.copy()
