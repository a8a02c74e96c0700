"""Verified matches to a reconstruction."""
