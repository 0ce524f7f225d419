"""Clouds: their order, and how their points scatter."""
