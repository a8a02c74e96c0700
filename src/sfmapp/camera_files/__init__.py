"""Camera files: calibrations in the forms of other programs."""
