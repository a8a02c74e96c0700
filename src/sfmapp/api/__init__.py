"""What Python sees: one call, the stages, the parts."""
