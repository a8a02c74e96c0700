"""Keypoints and descriptors."""
