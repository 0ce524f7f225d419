"""Evidence for and against the map of a finished run, one module a kind."""

from slam.diagnostics.evidence.assessment import assess_run

__all__ = ["assess_run"]
