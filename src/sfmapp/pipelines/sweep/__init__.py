"""``sfmapp sweep``: depth maps of a model, and its feature-occupancy volume."""
