"""Data association: gating by innovations, joint compatibility, decisions."""
