"""Two photographs of one moment: rectified, matched in every pixel, measured."""
