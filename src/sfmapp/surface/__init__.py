"""Patches to a mesh, and its texture."""
