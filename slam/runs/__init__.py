"""Runs: from a log or a cloud to an estimate."""
