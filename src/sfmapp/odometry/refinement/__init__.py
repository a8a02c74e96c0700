"""The calibration held against the map, and the final adjustment."""
