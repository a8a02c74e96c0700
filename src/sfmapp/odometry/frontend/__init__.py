"""Points followed from frame to frame."""
