"""Pure functions on arrays: rotations, triangulation, resection, two views."""
