"""Sensors: the rig, mounts, noise of wheels and scans, and what a log of them holds."""
