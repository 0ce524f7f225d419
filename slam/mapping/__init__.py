"""Mapping: landmark initialization, map update, fusion of landmarks; consistency (NIS) and observability."""
