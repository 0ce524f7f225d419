"""Measurements of speed and accuracy: each workload runs as ``python -m benchmarks NAME``."""
