"""Robust noise models: how much a factor that does not fit still pulls."""

from __future__ import annotations

import gtsam

from spplanes._check import as_positive

#: ``None``, the name of a kernel, or (name, k).
Robust = str | tuple[str, float] | None

_ESTIMATORS = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
}

#: 95 % quantile of chi2 by degrees of freedom: kernels act on the whitened norm of the whole error vector.
_CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815, 6: 12.592}


def with_robust(noise: gtsam.noiseModel.Base, robust: Robust, dof: int) -> gtsam.noiseModel.Base:
    """Wrap ``noise`` in a robust kernel.

    ``robust`` is None, a name ("huber", "cauchy", "geman-mcclure", "dcs") or (name, k). k is in units of the whitened
    norm sqrt(e^T C^-1 e); "dcs" takes its phi, which is in units of its square. By default the kernel starts to bite
    where an honest error of ``dof`` degrees of freedom is in 5 % of all cases. Unknown names: ValueError.
    """
    if robust is None:
        return noise
    name, k = robust if isinstance(robust, tuple) else (robust, None)
    if name not in _ESTIMATORS:
        raise ValueError(f"robust: expected None or one of {', '.join(sorted(_ESTIMATORS))}, got {name!r}")
    if k is None:
        k = _CHI2_95[dof] if name == "dcs" else _CHI2_95[dof] ** 0.5
    return gtsam.noiseModel.Robust.Create(_ESTIMATORS[name].Create(as_positive("robust", k)), noise)
