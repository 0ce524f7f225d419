"""Peers that need an environment of their own, and what runs in it: see `benchmarks.peers.environment`."""
