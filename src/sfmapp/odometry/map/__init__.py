"""Keyframes and landmarks, and the adjustment of a window of them."""
