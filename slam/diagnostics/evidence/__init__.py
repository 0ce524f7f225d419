"""Evidence for and against the map of a finished run, one module a kind."""

from slam.diagnostics.evidence.assessment import assess_run
from slam.diagnostics.evidence.finished import Finished

__all__ = ["Finished", "assess_run"]
