"""Refinement of labelled regions: borders, creases, misfits."""
