"""Validation of fitted planes: one plane or two, where planes end, planes that others explain better."""
