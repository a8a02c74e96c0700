"""Which images are matched, matches, and two-view geometries."""
