"""Photographs that were taken turning on the spot, to rotations and to one picture."""
