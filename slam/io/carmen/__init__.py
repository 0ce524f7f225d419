"""CARMEN logs: reading and writing."""
