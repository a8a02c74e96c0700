"""A sequence to a trajectory, and a finished run refined."""
