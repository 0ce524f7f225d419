"""Data association: gating by innovations, joint compatibility, decisions and their probabilities."""
