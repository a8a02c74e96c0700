"""Policies: what is done in which order, kept and written."""
