"""Photographs and video into cameras, points and surfaces, on an ordinary CPU, from pip alone."""
