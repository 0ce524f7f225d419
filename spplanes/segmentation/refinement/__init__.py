"""Refinement of labelled regions: borders, creases, steps, parallel planes."""
