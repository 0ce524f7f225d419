"""Evidence for and against the map of a finished run, one module a kind."""

from slam.diagnostics.evidence.finished import Finished
from slam.diagnostics.evidence.look import look_at

__all__ = ["Finished", "look_at"]
