"""Evidence: chi2 of what was matched says that errors are larger than claimed, and by so much that it matters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtrc, ndtr

from slam.backend.estimator import pose_symbol
from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.verdict import SIGNIFICANCE, Evidence, named
from slam.geometry.frames import evenly

#: What a user is promised of a sound map: no error beyond this, m, or so many of the standard deviations it claims.
PROMISED_M, PROMISED_SIGMAS = 0.1, 3.0
#: Poses whose standard deviation is looked at, evenly over the run.
_MOST_POSES = 24


def claimed_sigmas(run: Finished) -> dict[int, float]:
    """Largest standard deviation of the position of some keyframes, by their index, m."""
    chosen = evenly(len(run.keyframes), _MOST_POSES)
    blocks = {key: run.backend.read_covariance(pose_symbol(key))[3:, 3:] for key in chosen}
    return {key: float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for key, block in blocks.items()}


def nis_evidence(run: Finished) -> Iterator[Evidence]:
    """Accepted matches scatter more than their covariances say, and the poses err by as much more.

    The mean NIS is the factor by which the covariances are too small, if it is of all measurements alike; it matters
    where errors larger by its root would break what a sound map promises more often than once in a hundred cases.
    """
    rows = [row for history in run.audit.history.values() for row in history]
    dof = sum(row[2] for row in rows)
    if not dof:
        return
    total = float(sum(row[1] for row in rows))
    scattered = "what was matched scatters {0:.2g} times as much as stated: "
    sentence = scattered + "claimed sigmas up to {1:.2g} m are too small by that"
    yield from too_small(run, "innovations", (total, dof), sentence)


def too_small(
    run: Finished, kind: str, test: tuple[float, float], sentence: str, *, frames: tuple[int, ...] = (), tests: int = 1
) -> Iterator[Evidence]:
    """Covariances that are too small by chi2 over what is expected of it (`test`), where that breaks the promise.

    The sentence names the factor on sigma and the largest sigma claimed; what it says comes from `frames`, of so many
    `tests`.
    """
    chi2, dof = test
    factor, sigmas = float(np.sqrt(max(chi2 / dof, 1.0))), claimed_sigmas(run)
    risky = [key for key, sigma in sigmas.items() if _risk(factor * sigma, sigma) > SIGNIFICANCE]
    if risky:
        p_value = min(tests * float(chdtrc(dof, chi2)), 1.0)
        told = f"{sentence.format(factor, max(sigmas.values()))} at {named(risky)}"
        every = tuple(sorted({*frames, *risky}))
        yield Evidence(kind, "doubtful", p_value, factor, "times the stated sigma", every, told)


def _risk(sigma_m: float, claimed_m: float) -> float:
    """Probability that an error of standard deviation `sigma_m` breaks the promise where `claimed_m` is claimed."""
    return 2.0 * float(ndtr(-max(PROMISED_M, PROMISED_SIGMAS * claimed_m) / max(sigma_m, 1e-12)))
