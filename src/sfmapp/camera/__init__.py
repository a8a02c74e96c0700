"""Lenses: project, unproject and their derivatives."""
