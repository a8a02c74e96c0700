"""Calibration of cameras: from boards, targets, lines and rigs to parameters with their sigmas."""
