"""Fleet: many missions mapped on many workers, and joined. Needs the extra `fleet` (Dask distributed)."""

from slam.fleet.fleet import FleetError, run

__all__ = ["FleetError", "run"]
