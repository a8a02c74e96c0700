"""Photographs to a model."""
