"""Photographs from all sides to a closed volume."""
