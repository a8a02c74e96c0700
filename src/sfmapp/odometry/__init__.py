"""Frames to a trajectory and a keyframe map."""
