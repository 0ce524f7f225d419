"""Mapping: landmark initialization, map update, and the fusion of landmarks that are one plane."""
