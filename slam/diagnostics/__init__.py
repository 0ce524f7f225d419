"""Diagnostics: the verdict on a finished run, and the evidence for it."""
