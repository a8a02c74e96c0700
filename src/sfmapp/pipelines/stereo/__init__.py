"""Pairs of photographs to disparities and depths."""
