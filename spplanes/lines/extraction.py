"""Line extraction from one scan of a 2D laser, with the covariance of every line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import log
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_float_array, as_number, as_positive, as_shape, check_instance
from spplanes.fitting.shared_error import shared_error_of
from spplanes.line import ScanLine
from spplanes.lines._extract import Rules, extract


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
        are_whole = [isinstance(number, int | np.integer) for number in (self.min_points, self.max_missing)]
        for name, valid, expected in (
            ("bearing_sigma", 0.0 <= self.bearing_sigma < np.pi, "an angle >= 0"),
            ("flatness", 0.0 <= self.flatness < np.inf, "a distance >= 0"),
            ("significance", 0.0 < self.significance < 0.5, "a probability in (0, 0.5)"),
            ("min_points", are_whole[0] and self.min_points >= 3, "a whole number of beams >= 3"),
            ("max_missing", are_whole[1] and self.max_missing >= 0, "a whole number of beams >= 0"),
            ("max_turning", 0.0 < self.max_turning < np.pi, "an angle in (0, pi)"),
            ("max_nonlinearity", self.max_nonlinearity > 0.0, "a ratio above 0"),
            ("max_misfit", self.max_misfit > 1.0, "a ratio above 1"),
            ("range_min", 0.0 <= self.range_min < np.inf, "a finite range >= 0"),
            ("range_max", self.range_max > self.range_min, "a range above range_min"),
        ):
            if not valid:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")


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
    flatness = 0.0 if shared_error else config.flatness  # else it is counted with what residuals show
    beams, rows, support, counts = _extracted(ranges, angles, sigma, config, flatness)
    if shared_error and len(rows):
        rows[:, 4:8] = _with_shared_error(rows, support, counts, beams, config).reshape(-1, 4)
    ends, blocks = np.cumsum(counts), rows[:, 4:].reshape(-1, 2, 2, 2)
    return [
        ScanLine._trusted(alpha, rho, block[0], block[1], support[end - count : end], chi2, int(dof))
        for (alpha, rho, chi2, dof), block, count, end in zip(rows[:, :4].tolist(), blocks, counts, ends, strict=True)
    ]


def _extracted(
    ranges: ArrayLike, angles: ArrayLike, sigma: ArrayLike, config: LineConfig, flatness: float
) -> tuple[FloatArray, FloatArray, np.ndarray, np.ndarray]:
    """The beams (3, B) of a scan, and its lines as `extract` gives them: rows (M, 12), support (N,), counts (M,)."""
    distances = as_shape("ranges", ranges, (None,), finite=False)
    bearings = as_shape("angles", angles, distances.shape)
    largest = float(np.abs(bearings).max(initial=0.0))
    if largest > 4.0 * np.pi:  # two turns: no convention writes a bearing beyond, and any scan in degrees does
        raise ValueError(f"angles: expected bearings in radians, got {largest:.6g}, as if in degrees")
    beams = np.stack((distances, bearings, _as_sigmas(sigma, distances.size)))
    if beams.shape[1] < 3:
        return beams, np.empty((0, 12)), np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    # always of the same types: for others kernels would be compiled anew
    own: dict[str, Any] = {field.name: type(field.default)(getattr(config, field.name)) for field in fields(config)}
    rules = Rules(gate=-2.0 * log(config.significance), stated=float(flatness), **own)
    return beams, *extract(beams[0], beams[1], beams[2], rules)


def _as_sigmas(sigma: ArrayLike, n: int) -> FloatArray:
    """Standard deviation per beam, shape (n,)."""
    if np.ndim(sigma) == 0:
        return np.full(n, as_positive("sigma", as_float_array("sigma", sigma).item()))
    sigmas = as_shape("sigma", sigma, (n,))
    if n and sigmas.min() <= 0.0:
        raise ValueError(f"sigma: expected positive standard deviations, got {sigmas.min()}")
    return sigmas


def beam_noise(scans: Sequence[tuple[FloatArray, FloatArray]], sigma: float, config: LineConfig) -> tuple[float, int]:
    """How far beams scatter about the lines that they are on, for lasers that nobody describes.

    Inside of patches of lines, so that walls need not be straight; of most lines, for some are two surfaces.

    Args:
        scans: ranges and bearings of each, as of `extract_lines`; those that it refuses are left out.
        sigma: standard deviation of a range by which lines are looked for, m: about what it may be.
        config: what counts as a line.

    Returns:
        The standard deviation of a range, the unevenness of walls over less than a patch in it, m; and the number of
        beams that tell of it.
    """
    seen, telling = _scatter(scans, sigma, config)
    return _scatter(scans, seen, config) if seen > sigma else (seen, telling)  # too little breaks lines up


def _scatter(scans: Sequence[tuple[FloatArray, FloatArray]], sigma: float, config: LineConfig) -> tuple[float, int]:
    """See `beam_noise`; by lines that are looked for once."""
    found, first = [], 0
    for ranges, angles in scans:
        try:
            beams, rows, support, counts = _extracted(ranges, angles, sigma, config, 0.0)
        except ValueError:  # who takes its lines will hear of it
            continue
        seen = _Residuals.of(rows, support, counts, beams, config)
        found.append((seen.points, seen.variances, seen.line + first, seen.covariances))
        first += len(rows)
    if not first:
        return sigma, 0
    points, variances, line, covariances = (np.concatenate(parts) for parts in zip(*found, strict=True))
    frames = np.tile(np.eye(4), (first, 1, 1))
    shown = shared_error_of(points, variances[:, None], line, frames, covariances, stated=False)
    common = shown.noise_factors.min()  # that of most lines: others have more of their own
    return sigma * float(np.sqrt(common)), len(points)


class _Residuals(NamedTuple):
    """Beams on M lines as points of planes that have no height, each plane in its own frame."""

    points: FloatArray
    """Along the line from its middle, 0, and how far off it, shape (N, 3), m."""
    variances: FloatArray
    """Of how far off, shape (N,), m^2."""
    line: np.ndarray
    """Of each beam, shape (N,)."""
    covariances: FloatArray
    """Of the (z, theta, psi) of the planes by the noise that is stated, shape (M, 3, 3)."""
    along: FloatArray
    """Where along the line each beam meets it, from the foot of the normal, shape (N,), m."""
    to_sp: FloatArray
    """(z, theta) by (alpha, rho), about the point where shift and direction are uncorrelated, shape (M, 2, 2)."""

    @classmethod
    def of(
        cls, rows: FloatArray, support: np.ndarray, counts: np.ndarray, beams: FloatArray, config: LineConfig
    ) -> _Residuals:
        """Of what `extract` found, see `_with_shared_error`."""
        alpha, rho, stated = rows[:, 0], rows[:, 1], rows[:, 4:8].reshape(-1, 2, 2)
        line, (ranges, angles, sigmas) = np.repeat(np.arange(len(rows)), counts), beams[:, support]
        turn = angles - alpha[line]
        cosine, along = np.cos(turn), rho[line] * np.tan(turn)
        # about the point where shift and direction are uncorrelated: z = d rho - middle d alpha, theta = d alpha
        middle, to_sp = stated[:, 0, 1] / stated[:, 0, 0], np.zeros((len(rows), 2, 2))
        to_sp[:, 0, 0], to_sp[:, 0, 1], to_sp[:, 1, 0] = -middle, 1.0, 1.0
        noise = to_sp @ stated @ np.swapaxes(to_sp, 1, 2)
        covariances = np.zeros((len(rows), 3, 3))
        covariances[:, :2, :2], covariances[:, 2, 2] = noise, 1e12 * noise[:, 0, 0]  # no height: the tilt is open
        points = np.zeros((len(support), 3))
        points[:, 0], points[:, 2] = along - middle[line], ranges * cosine - rho[line]
        variances = (sigmas * cosine) ** 2 + (config.bearing_sigma * along) ** 2
        return cls(points, variances, line, covariances, along, to_sp)


def _with_shared_error(
    rows: FloatArray, support: np.ndarray, counts: np.ndarray, beams: FloatArray, config: LineConfig
) -> FloatArray:
    """Covariances of (alpha, rho) of lines with the noise and the shared error that residuals show, shape (M, 2, 2).
    The mechanism is that of planes: a line is a plane whose points have no height. What is stated is a lower bound: the
    noise by the covariances of the lines, see `extract`, the shared error by `LineConfig.flatness`."""
    seen = _Residuals.of(rows, support, counts, beams, config)
    frames = np.tile(np.eye(4), (len(rows), 1, 1))
    found = shared_error_of(seen.points, seen.variances[:, None], seen.line, frames, seen.covariances, stated=True)
    total, from_sp = found.covariances[:, :2, :2], np.linalg.inv(seen.to_sp)
    result = from_sp @ total @ np.swapaxes(from_sp, 1, 2)
    # An uneven wall shifts by its flatness, and turns by sqrt(12) / length of it about its middle: what residuals do
    # not show of these variances of shift and direction is added.
    ends = np.cumsum(counts) - 1
    first, last, flat = seen.along[ends - counts + 1], seen.along[ends], np.full(len(rows), config.flatness)
    stated = np.stack((flat**2, 12.0 * (flat / np.abs(last - first)) ** 2), axis=-1)
    shown = (total - found.noise_factors[:, None, None] * seen.covariances[:, :2, :2])[:, (0, 1), (0, 1)]
    left = np.maximum(stated - shown, 0.0)
    by_turn = np.stack((np.ones(len(rows)), 0.5 * (last + first)), axis=-1)
    result += left[:, 1, None, None] * by_turn[:, :, None] * by_turn[:, None, :]
    result[:, 1, 1] += left[:, 0]
    return 0.5 * (result + np.swapaxes(result, 1, 2))
