"""File formats of other programs, and every change of convention."""
