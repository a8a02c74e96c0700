"""Recordings and live views in rerun."""
