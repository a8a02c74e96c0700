"""Which frames of a video are worth reconstructing, and what the frames between them tell."""
