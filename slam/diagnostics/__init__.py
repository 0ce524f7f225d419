"""Diagnostics: consistency (NIS), observability and degeneracy, explanations of decisions."""
