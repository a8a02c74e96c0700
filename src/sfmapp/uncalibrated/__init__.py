"""Photographs of cameras that nobody has calibrated: projective models, upgrades, and third views."""
