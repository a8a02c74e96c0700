"""Reconstructions in the world: coordinate systems, positions of photographs, and models brought to metres."""
