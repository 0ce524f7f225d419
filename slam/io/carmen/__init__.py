"""CARMEN logs: reading and writing."""

from slam.io.carmen.reader import read_carmen
from slam.io.carmen.writer import write_carmen

__all__ = ["read_carmen", "write_carmen"]
