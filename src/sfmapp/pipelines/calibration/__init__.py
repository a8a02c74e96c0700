"""Calibrating cameras."""
