"""Planes in photographs: pictures put onto them, and what they show taken out."""
