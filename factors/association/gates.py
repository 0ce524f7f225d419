"""The gates of data association: significances and bounds, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, fields

from spplanes._check import as_number


@dataclass(frozen=True)
class AssociationGates:
    """When a measured plane is the landmark's plane.

    Raises:
        ValueError: a significance outside (0, 1), a factor or an angle that is not positive, a negative bound.
    """

    significance: float = 1e-3
    """A match is accepted below the chi2 quantile 1 - significance: one true match in 1 / significance is missed."""
    new_significance: float = 1e-6
    """A measurement starts a landmark only when every candidate lies above this quantile; between, it is unsure."""
    chance_factor: float = 1.0
    """A match must be likelier than a plane there by chance; how dense planes lie is taken from the landmarks about the
    observation, times this."""
    rival_log_ratio: float = 4.6
    """A match waits while another landmark is at most exp(this) times less likely: 100 to 1."""
    max_angle_rad: float = 0.35
    """Normals further apart than this, plus `bound_sigmas` of the state, are not compared, rad."""
    gap_m: float = 1.5
    """Patches of one wall may lie this far apart beside the state's own uncertainty, m: more than a door is wide."""
    bound_sigmas: float = 3.0
    """Standard deviations of the pose by which the bounds are wider, before chi2 decides."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = as_number(field.name, getattr(self, field.name))
            if field.name in ("significance", "new_significance"):
                if not 0.0 < value < 1.0:
                    raise ValueError(f"{field.name}: expected a probability between 0 and 1, got {value}")
            elif field.name in ("chance_factor", "max_angle_rad"):
                if value <= 0.0:
                    raise ValueError(f"{field.name}: expected a positive number, got {value}")
            elif value < 0.0:
                raise ValueError(f"{field.name}: expected a number >= 0, got {value}")
