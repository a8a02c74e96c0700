"""Volumes out of photographs from all sides: silhouettes, shadows, colours, planes."""
