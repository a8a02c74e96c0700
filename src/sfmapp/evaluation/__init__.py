"""Errors of poses, trajectories and clouds, and pycolmap as a second opinion."""
