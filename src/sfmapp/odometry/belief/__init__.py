"""Where a camera is in a map that was there before, as far as that can be told: places that look alike stay open."""
