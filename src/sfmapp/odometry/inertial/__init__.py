"""Metres and gravity: inertial measurements, markers, known lengths."""
