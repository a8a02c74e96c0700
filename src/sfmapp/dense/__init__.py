"""Cameras and photographs to oriented patches."""
