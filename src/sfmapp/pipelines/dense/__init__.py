"""Patches and meshes of a workspace or a COLMAP model."""
