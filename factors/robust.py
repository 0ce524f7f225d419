"""Robust noise models: how much a factor that does not fit still pulls."""

from __future__ import annotations

import gtsam

from spplanes._check import FloatArray, as_positive

#: ``None``, the name of a kernel, or (name, k).
Robust = str | tuple[str, float] | None

_ESTIMATORS = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
}


def with_robust(noise: gtsam.noiseModel.Base, robust: Robust, dof: int) -> gtsam.noiseModel.Base:
    """Wrap ``noise`` in a robust kernel.

    ``robust`` is None, a name ("huber", "cauchy", "geman-mcclure", "dcs") or (name, k). k is in units of the whitened
    norm sqrt(e^T C^-1 e); "dcs" takes its phi, which is in units of its square. By default k is where an honest error
    of ``dof`` degrees of freedom is in 5 % of all cases. Unknown names: ValueError.
    """
    chosen = resolve_robust(robust, dof)
    if chosen is None:
        return noise
    name, k = chosen
    return gtsam.noiseModel.Robust.Create(_ESTIMATORS[name].Create(k), noise)


def resolve_robust(robust: Robust, dof: int) -> tuple[str, float] | None:
    """Name and constant of a kernel, the default filled in."""
    if robust is None:
        return None
    name, k = robust if isinstance(robust, tuple) and len(robust) == 2 else (robust, None)
    if not isinstance(name, str) or name not in _ESTIMATORS:
        raise ValueError(
            f"robust: expected None, one of {', '.join(sorted(_ESTIMATORS))}, or (name, k), got {robust!r}"
        )
    if k is None:  # kernels act on the whitened norm of the whole error vector
        from scipy.special import chdtri  # `import factors` takes no SciPy

        quantile = round(float(chdtri(dof, 0.05)), 3)
        return name, quantile if name == "dcs" else quantile**0.5
    return name, as_positive("robust", k)


def gaussian(root_information: FloatArray, robust: Robust, dof: int) -> gtsam.noiseModel.Base:
    """Noise model with |R e|^2 as its squared norm, R = ``root_information`` (m, m) upper triangular."""
    return with_robust(gtsam.noiseModel.Gaussian.SqrtInformation(root_information, False), robust, dof)
